// volume + sigmoid(weight . volume + bias) * bev, the bird's-eye view repeated along the last axis.
struct Shape { channels: u32, columns: u32, depth: u32 }

@group(0) @binding(0) var<storage, read> s: Shape;
@group(0) @binding(1) var<storage, read> volume: array<f32>; // [channels, columns, depth]
@group(0) @binding(2) var<storage, read> bev: array<f32>; // [channels, columns]
@group(0) @binding(3) var<storage, read> weight: array<f32>; // [channels]
@group(0) @binding(4) var<storage, read> bias: array<f32>; // [1]
@group(0) @binding(5) var<storage, read_write> out: array<f32>; // [channels, columns, depth]

@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) n: vec3<u32>) {
    let i = id.y * n.x * 64u + id.x;
    if i >= arrayLength(&out) { return; }
    let voxel = i % (s.columns * s.depth);
    let c = i / (s.columns * s.depth);
    var dot = bias[0];
    for (var k = 0u; k < s.channels; k++) { dot += weight[k] * volume[k * s.columns * s.depth + voxel]; }
    out[i] = volume[i] + 1.0 / (1.0 + exp(-dot)) * bev[c * s.columns + voxel / s.depth];
}
