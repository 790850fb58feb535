// Modulated deformable 3x3 convolution (DCNv2, arXiv 1811.11168) in integers, stride 1, padding 1, one offset group.
// offsets: 18 channels (dy, dx) per tap in units of 1/256 pixel, then 9 mask logits in units of 1/64. A corner weighs its
// share of the pixel (16 bits) times the mask (10 bits), rounded to 14 bits; corners outside x are 0; a sample is 8 bits.
struct Shape { inputs: u32, outputs: u32, residual: u32, relu: u32, height: i32, width: i32 }

@group(0) @binding(0) var<storage, read> s: Shape;
@group(0) @binding(1) var<storage, read> x: array<i32>; // [inputs, height, width]
@group(0) @binding(2) var<storage, read> offsets: array<i32>; // [27, height, width]
@group(0) @binding(3) var<storage, read> weight: array<i32>; // [outputs, inputs, 3, 3]
@group(0) @binding(4) var<storage, read> columns: array<i32>; // [3, outputs]: bias, multiplier, the residual's multiplier
@group(0) @binding(5) var<storage, read> residual: array<i32>; // [outputs, height, width], or one number that is not read
@group(0) @binding(6) var<storage, read> sigmoid: array<i32>; // [1024]: of -8, -8 + 1/64, ... in units of 1/1024
@group(0) @binding(7) var<storage, read_write> out: array<i32>; // [outputs, height, width]

// No image is so large that a position this far from it were inside.
const FAR = 1 << 29u;

fn pixel(c: u32, y: i32, x_: i32) -> i32 {
    if y < 0 || y >= s.height || x_ < 0 || x_ >= s.width { return 0; }
    return x[(i32(c) * s.height + y) * s.width + x_];
}

fn corner(down: i32, right: i32, mask: i32) -> i32 {
    return (down * right * mask + (1 << 11u)) >> 12u;
}

fn sample(c: u32, y: i32, x_: i32, mask: i32) -> i32 {
    let top = y >> 8u;
    let left = x_ >> 8u;
    let down = y & 255;
    let right = x_ & 255;
    let sum = corner(256 - down, 256 - right, mask) * pixel(c, top, left)
        + corner(256 - down, right, mask) * pixel(c, top, left + 1)
        + corner(down, 256 - right, mask) * pixel(c, top + 1, left)
        + corner(down, right, mask) * pixel(c, top + 1, left + 1);
    return clamp8((sum + (1 << 13u)) >> 14u);
}

@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) n: vec3<u32>) {
    let i = id.y * n.x * 64u + id.x;
    if i >= arrayLength(&out) { return; }
    let plane = s.height * s.width;
    let o = i / u32(plane);
    let p = i32(i) % plane;
    var sum = columns[o];
    for (var tap = 0; tap < 9; tap++) {
        let y = (p / s.width - 1 + tap / 3) * 256 + clamp(offsets[2 * tap * plane + p], -FAR, FAR);
        let x_ = (p % s.width - 1 + tap % 3) * 256 + clamp(offsets[(2 * tap + 1) * plane + p], -FAR, FAR);
        let mask = sigmoid[clamp(offsets[(18 + tap) * plane + p], -512, 511) + 512];
        for (var c = 0u; c < s.inputs; c++) {
            sum += weight[(o * s.inputs + c) * 9u + u32(tap)] * sample(c, y, x_, mask);
        }
    }
    var addend = 0;
    if s.residual != 0u { addend = residual[i] * columns[2u * s.outputs + o]; }
    out[i] = clamp8(requantise(join(sum, s.residual, s.relu, addend), columns[s.outputs + o]));
}
