// Modulated deformable 3x3 convolution (DCNv2, arXiv 1811.11168), stride 1, padding 1, one offset group, no bias.
// offsets: 18 channels (dy, dx) per tap, then 9 mask logits. A sample is bilinear; corners outside x are 0.
struct Shape { inputs: u32, outputs: u32, height: u32, width: u32 }

@group(0) @binding(0) var<storage, read> s: Shape;
@group(0) @binding(1) var<storage, read> x: array<f32>; // [inputs, height, width]
@group(0) @binding(2) var<storage, read> offsets: array<f32>; // [27, height, width]
@group(0) @binding(3) var<storage, read> weight: array<f32>; // [outputs, inputs, 3, 3]
@group(0) @binding(4) var<storage, read_write> out: array<f32>; // [outputs, height, width]

fn pixel(c: u32, y: f32, x_: f32) -> f32 {
    if y < 0.0 || y >= f32(s.height) || x_ < 0.0 || x_ >= f32(s.width) { return 0.0; }
    return x[(c * s.height + u32(y)) * s.width + u32(x_)];
}

fn sample(c: u32, y: f32, x_: f32) -> f32 {
    if y <= -1.0 || y >= f32(s.height) || x_ <= -1.0 || x_ >= f32(s.width) { return 0.0; }
    let top = floor(y);
    let left = floor(x_);
    let down = y - top;
    let right = x_ - left;
    return (1.0 - down) * (1.0 - right) * pixel(c, top, left) + (1.0 - down) * right * pixel(c, top, left + 1.0)
        + down * (1.0 - right) * pixel(c, top + 1.0, left) + down * right * pixel(c, top + 1.0, left + 1.0);
}

@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) n: vec3<u32>) {
    let i = id.y * n.x * 64u + id.x;
    if i >= arrayLength(&out) { return; }
    let plane = s.height * s.width;
    let o = i / plane;
    let p = i % plane;
    let y = f32(p / s.width);
    let x_ = f32(p % s.width);
    var sum = 0.0;
    for (var tap = 0u; tap < 9u; tap++) {
        let at_y = y - 1.0 + f32(tap / 3u) + offsets[2u * tap * plane + p];
        let at_x = x_ - 1.0 + f32(tap % 3u) + offsets[(2u * tap + 1u) * plane + p];
        let mask = 1.0 / (1.0 + exp(-offsets[(18u + tap) * plane + p]));
        for (var c = 0u; c < s.inputs; c++) {
            sum += weight[(o * s.inputs + c) * 9u + tap] * (mask * sample(c, at_y, at_x));
        }
    }
    out[i] = sum;
}
