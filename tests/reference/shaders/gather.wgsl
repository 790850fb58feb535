// The mean over the pixels that a row of the matrix names; 0 for an empty row.
struct Shape { channels: u32, pixels: u32, rows: u32 }

@group(0) @binding(0) var<storage, read> s: Shape;
@group(0) @binding(1) var<storage, read> ptr: array<u32>; // [rows + 1]
@group(0) @binding(2) var<storage, read> col: array<u32>; // camera * pixels + pixel
@group(0) @binding(3) var<storage, read> features: array<f32>; // [cameras, channels, pixels]
@group(0) @binding(4) var<storage, read_write> out: array<f32>; // [channels, rows]

@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) n: vec3<u32>) {
    let i = id.y * n.x * 64u + id.x;
    if i >= arrayLength(&out) { return; }
    let c = i / s.rows;
    let row = i % s.rows;
    var sum = 0.0;
    for (var e = ptr[row]; e < ptr[row + 1u]; e++) {
        let camera = col[e] / s.pixels;
        sum += features[(camera * s.channels + c) * s.pixels + col[e] % s.pixels];
    }
    out[i] = sum / f32(max(ptr[row + 1u] - ptr[row], 1u));
}
