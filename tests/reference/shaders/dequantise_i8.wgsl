// 8-bit integers to numbers: times the scale.
@group(0) @binding(0) var<storage, read> scale: array<f32>; // [1]
@group(0) @binding(1) var<storage, read> x: array<i32>;
@group(0) @binding(2) var<storage, read_write> out: array<f32>;

@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) n: vec3<u32>) {
    let i = id.y * n.x * 64u + id.x;
    if i >= arrayLength(&out) { return; }
    out[i] = f32(x[i]) * scale[0];
}
