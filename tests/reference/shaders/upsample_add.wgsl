// Nearest neighbour, added: out[y, x] = x[y, x] + low[floor(y * low_height / height), floor(x * low_width / width)].
struct Shape { channels: u32, low_height: u32, low_width: u32, height: u32, width: u32 }

@group(0) @binding(0) var<storage, read> s: Shape;
@group(0) @binding(1) var<storage, read> x: array<f32>; // [channels, height, width]
@group(0) @binding(2) var<storage, read> low: array<f32>; // [channels, low_height, low_width]
@group(0) @binding(3) var<storage, read_write> out: array<f32>; // [channels, height, width]

@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) n: vec3<u32>) {
    let i = id.y * n.x * 64u + id.x;
    if i >= arrayLength(&out) { return; }
    let at_x = i % s.width;
    let at_y = i / s.width % s.height;
    let c = i / (s.width * s.height);
    let source = (c * s.low_height + at_y * s.low_height / s.height) * s.low_width + at_x * s.low_width / s.width;
    out[i] = x[i] + low[source];
}
