// Image bytes, blue first, times a factor and plus an offset in units of 2^-20 steps, padded with zeros.
struct Shape { height: u32, width: u32, padded_height: u32, padded_width: u32 }

@group(0) @binding(0) var<storage, read> s: Shape;
@group(0) @binding(1) var<storage, read> image: array<i32>; // [height, width, 3]
@group(0) @binding(2) var<storage, read> factors: array<i32>; // [2, 3]: factors, offsets
@group(0) @binding(3) var<storage, read_write> out: array<i32>; // [3, padded_height, padded_width]

@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) n: vec3<u32>) {
    let i = id.y * n.x * 64u + id.x;
    if i >= arrayLength(&out) { return; }
    let x = i % s.padded_width;
    let y = i / s.padded_width % s.padded_height;
    let c = i / (s.padded_width * s.padded_height);
    var value = 0;
    if y < s.height && x < s.width {
        value = clamp8((image[(y * s.width + x) * 3u + c] * factors[c] + factors[3u + c] + (1 << 19u)) >> 20u);
    }
    out[i] = value;
}
