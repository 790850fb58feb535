// The mean over the pixels that a row of the matrix names, times a factor, and a bias, in units of 2^-21 steps of the result.
struct Shape { channels: u32, pixels: u32, rows: u32, relu: u32 }

@group(0) @binding(0) var<storage, read> s: Shape;
@group(0) @binding(1) var<storage, read> ptr: array<u32>; // [rows + 1]
@group(0) @binding(2) var<storage, read> col: array<u32>; // camera * pixels + pixel
@group(0) @binding(3) var<storage, read> features: array<i32>; // [cameras, channels, pixels]
@group(0) @binding(4) var<storage, read> factor: array<i32>; // [1 + channels]: the factor, then the bias
@group(0) @binding(5) var<storage, read_write> out: array<i32>; // [channels, rows]

@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) n: vec3<u32>) {
    let i = id.y * n.x * 64u + id.x;
    if i >= arrayLength(&out) { return; }
    let c = i / s.rows;
    let row = i % s.rows;
    var sum = 0;
    for (var e = ptr[row]; e < ptr[row + 1u]; e++) {
        let camera = col[e] / s.pixels;
        sum += features[(camera * s.channels + c) * s.pixels + col[e] % s.pixels];
    }
    let entries = max(i32(ptr[row + 1u] - ptr[row]), 1);
    let multiplier = (factor[0] + entries / 2) / entries;
    let y = (sum * multiplier + factor[1u + c] + (1 << 20u)) >> 21u;
    out[i] = select(clamp8(y), clamp(y, 0, 127), s.relu != 0u);
}
