// A plane cut off, or continued with zeros, at the ends of both axes.
struct Shape { channels: u32, height: u32, width: u32, out_height: u32, out_width: u32 }

@group(0) @binding(0) var<storage, read> s: Shape;
@group(0) @binding(1) var<storage, read> x: array<f32>; // [channels, height, width]
@group(0) @binding(2) var<storage, read_write> out: array<f32>; // [channels, out_height, out_width]

@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) n: vec3<u32>) {
    let i = id.y * n.x * 64u + id.x;
    if i >= arrayLength(&out) { return; }
    let at_x = i % s.out_width;
    let at_y = i / s.out_width % s.out_height;
    let c = i / (s.out_width * s.out_height);
    var value = 0.0;
    if at_y < s.height && at_x < s.width { value = x[(c * s.height + at_y) * s.width + at_x]; }
    out[i] = value;
}
