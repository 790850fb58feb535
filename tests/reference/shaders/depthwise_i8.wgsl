// Depthwise convolution in integers, stride 1, zero padding that keeps the size; the input joins, times its multiplier.
struct Shape { channels: u32, height: i32, width: i32, side: i32, residual: u32 }

@group(0) @binding(0) var<storage, read> s: Shape;
@group(0) @binding(1) var<storage, read> x: array<i32>; // [channels, height, width]
@group(0) @binding(2) var<storage, read> weight: array<i32>; // [channels, side, side]
@group(0) @binding(3) var<storage, read> columns: array<i32>; // [3, channels]: bias, multiplier, the residual's multiplier
@group(0) @binding(4) var<storage, read_write> out: array<i32>; // [channels, height, width]

@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) n: vec3<u32>) {
    let i = id.y * n.x * 64u + id.x;
    if i >= arrayLength(&out) { return; }
    let plane = s.height * s.width;
    let c = i32(i) / plane;
    let p = i32(i) % plane;
    var sum = columns[c];
    for (var a = 0; a < s.side; a++) {
        for (var b = 0; b < s.side; b++) {
            let y = p / s.width + a - s.side / 2;
            let x_ = p % s.width + b - s.side / 2;
            if y >= 0 && y < s.height && x_ >= 0 && x_ < s.width {
                sum += weight[(c * s.side + a) * s.side + b] * x[c * plane + y * s.width + x_];
            }
        }
    }
    if s.residual != 0u { sum += x[i] * columns[2 * i32(s.channels) + c]; }
    out[i] = clamp8(requantise(sum, columns[i32(s.channels) + c]));
}
