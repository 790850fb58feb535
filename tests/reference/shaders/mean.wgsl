// The mean of each channel over all positions.
struct Shape { channels: u32, positions: u32 }

@group(0) @binding(0) var<storage, read> s: Shape;
@group(0) @binding(1) var<storage, read> x: array<f32>; // [channels, positions]
@group(0) @binding(2) var<storage, read_write> out: array<f32>; // [channels]

@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) n: vec3<u32>) {
    let i = id.y * n.x * 64u + id.x;
    if i >= arrayLength(&out) { return; }
    var sum = 0.0;
    for (var p = 0u; p < s.positions; p++) { sum += x[i * s.positions + p]; }
    out[i] = sum / f32(s.positions);
}
