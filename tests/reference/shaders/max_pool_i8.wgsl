// The largest of each square window; positions outside x do not count.
struct Shape {
    channels: u32,
    height: u32,
    width: u32,
    out_height: u32,
    out_width: u32,
    side: u32,
    stride: u32,
    padding: u32,
}

@group(0) @binding(0) var<storage, read> s: Shape;
@group(0) @binding(1) var<storage, read> x: array<i32>; // [channels, height, width]
@group(0) @binding(2) var<storage, read_write> out: array<i32>; // [channels, out_height, out_width]

@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) n: vec3<u32>) {
    let i = id.y * n.x * 64u + id.x;
    if i >= arrayLength(&out) { return; }
    let to_x = i % s.out_width;
    let to_y = i / s.out_width % s.out_height;
    let c = i / (s.out_width * s.out_height);
    var largest = -128;
    for (var a = 0u; a < s.side; a++) {
        for (var b = 0u; b < s.side; b++) {
            // Below 0 these wrap to numbers larger than any extent.
            let y = to_y * s.stride + a - s.padding;
            let x_ = to_x * s.stride + b - s.padding;
            if y < s.height && x_ < s.width {
                largest = max(largest, x[(c * s.height + y) * s.width + x_]);
            }
        }
    }
    out[i] = largest;
}
