// Depthwise square convolution within windows that do not see each other; zeros outside a window. A plane is one window.
struct Shape { channels: u32, height: u32, width: u32, side: u32, window_height: u32, window_width: u32 }

@group(0) @binding(0) var<storage, read> s: Shape;
@group(0) @binding(1) var<storage, read> x: array<f32>; // [channels, height, width]
@group(0) @binding(2) var<storage, read> weight: array<f32>; // [channels, 1, side, side]
@group(0) @binding(3) var<storage, read_write> out: array<f32>; // [channels, height, width]

@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) n: vec3<u32>) {
    let i = id.y * n.x * 64u + id.x;
    if i >= arrayLength(&out) { return; }
    let at_x = i32(i % s.width);
    let at_y = i32(i / s.width % s.height);
    let c = i / (s.width * s.height);
    let top = at_y / i32(s.window_height) * i32(s.window_height);
    let left = at_x / i32(s.window_width) * i32(s.window_width);
    let bottom = min(top + i32(s.window_height), i32(s.height));
    let right = min(left + i32(s.window_width), i32(s.width));
    let side = i32(s.side);
    var sum = 0.0;
    for (var a = 0; a < side; a++) {
        for (var b = 0; b < side; b++) {
            let y = at_y + a - side / 2;
            let x_ = at_x + b - side / 2;
            if y >= top && y < bottom && x_ >= left && x_ < right {
                sum += weight[(i32(c) * side + a) * side + b] * x[(i32(c) * i32(s.height) + y) * i32(s.width) + x_];
            }
        }
    }
    out[i] = sum;
}
