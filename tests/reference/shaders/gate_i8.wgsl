// The volume and its gated bird's-eye view, each times its factor, in units of 2^-21 steps of the result.
struct Shape { channels: u32, columns: u32, depth: u32 }

@group(0) @binding(0) var<storage, read> s: Shape;
@group(0) @binding(1) var<storage, read> volume: array<i32>; // [channels, columns, depth]
@group(0) @binding(2) var<storage, read> bev: array<i32>; // [channels, columns]
@group(0) @binding(3) var<storage, read> weight: array<i32>; // [channels]
@group(0) @binding(4) var<storage, read> scalars: array<i32>; // bias, multiplier, the volume's factor, the other's
@group(0) @binding(5) var<storage, read> sigmoid: array<i32>; // [1024]: of -8, -8 + 1/64, ... in units of 1/1024
@group(0) @binding(6) var<storage, read_write> out: array<i32>; // [channels, columns, depth]

@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) n: vec3<u32>) {
    let i = id.y * n.x * 64u + id.x;
    if i >= arrayLength(&out) { return; }
    let voxel = i % (s.columns * s.depth);
    let c = i / (s.columns * s.depth);
    var sum = scalars[0];
    for (var k = 0u; k < s.channels; k++) { sum += weight[k] * volume[k * s.columns * s.depth + voxel]; }
    let gate = sigmoid[clamp(requantise(sum, scalars[1]), -512, 511) + 512];
    let taken = bev[c * s.columns + voxel / s.depth] * gate;
    out[i] = clamp8((volume[i] * scalars[2] + taken * scalars[3] + (1 << 20u)) >> 21u);
}
