// One number per channel, repeated at every position.
struct Shape { channels: u32, positions: u32 }

@group(0) @binding(0) var<storage, read> s: Shape;
@group(0) @binding(1) var<storage, read> x: array<i32>; // [channels]
@group(0) @binding(2) var<storage, read_write> out: array<i32>; // [channels, positions]

@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) n: vec3<u32>) {
    let i = id.y * n.x * 64u + id.x;
    if i >= arrayLength(&out) { return; }
    out[i] = x[i / s.positions];
}
