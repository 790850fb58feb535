// x and the nearest pixel of a smaller image, each times its factor, in units of 2^-13 steps of the result.
struct Shape { channels: u32, low_height: u32, low_width: u32, height: u32, width: u32 }

@group(0) @binding(0) var<storage, read> s: Shape;
@group(0) @binding(1) var<storage, read> x: array<i32>; // [channels, height, width]
@group(0) @binding(2) var<storage, read> low: array<i32>; // [channels, low_height, low_width]
@group(0) @binding(3) var<storage, read> factors: array<i32>; // [2]: of x and of low
@group(0) @binding(4) var<storage, read_write> out: array<i32>; // [channels, height, width]

@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) n: vec3<u32>) {
    let i = id.y * n.x * 64u + id.x;
    if i >= arrayLength(&out) { return; }
    let y = i / s.width % s.height * s.low_height / s.height;
    let x_ = i % s.width * s.low_width / s.width;
    let c = i / (s.width * s.height);
    let small = low[(c * s.low_height + y) * s.low_width + x_];
    out[i] = clamp8((x[i] * factors[0] + small * factors[1] + (1 << 12u)) >> 13u);
}
