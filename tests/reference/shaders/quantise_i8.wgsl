// Numbers to 8 bits: times the inverse of the scale, to the nearest integer, ties to even.
@group(0) @binding(0) var<storage, read> inverse: array<f32>; // [1]
@group(0) @binding(1) var<storage, read> x: array<f32>;
@group(0) @binding(2) var<storage, read_write> out: array<i32>;

@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) n: vec3<u32>) {
    let i = id.y * n.x * 64u + id.x;
    if i >= arrayLength(&out) { return; }
    out[i] = i32(round(clamp(x[i] * inverse[0], -127.0, 127.0)));
}
