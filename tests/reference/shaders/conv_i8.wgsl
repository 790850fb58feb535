// Convolution over three axes in integers; an image has depth 1.
// sum[o, p] = bias[o] + sum over i, tap of weight[o, i, tap] * x[i, p * stride - padding + tap * dilation], 0 outside x.
// out = requantise(sum with residual * its multiplier, and ReLU), clamped unless it is wide.
struct Shape {
    inputs: u32,
    outputs: u32,
    residual: u32, // 0 none, 1 before ReLU, 2 after it
    relu: u32,
    wide: u32,
    extent: vec3<i32>,
    output: vec3<i32>,
    kernel: vec3<i32>,
    stride: vec3<i32>,
    dilation: vec3<i32>,
    padding: vec3<i32>,
}

@group(0) @binding(0) var<storage, read> s: Shape;
@group(0) @binding(1) var<storage, read> x: array<i32>; // [inputs, extent]
@group(0) @binding(2) var<storage, read> weight: array<i32>; // [outputs, inputs, kernel]
@group(0) @binding(3) var<storage, read> columns: array<i32>; // [3, outputs]: bias, multiplier, the residual's multiplier
@group(0) @binding(4) var<storage, read> residual: array<i32>; // [outputs, output], or one number that is not read
@group(0) @binding(5) var<storage, read_write> out: array<i32>; // [outputs, output]

@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) n: vec3<u32>) {
    let i = id.y * n.x * 64u + id.x;
    if i >= arrayLength(&out) { return; }
    let positions = s.output.x * s.output.y * s.output.z;
    let o = i32(i) / positions;
    let p = i32(i) % positions;
    let to = vec3(p / (s.output.y * s.output.z), p / s.output.z % s.output.y, p % s.output.z);
    var sum = columns[o];
    for (var c = 0; c < i32(s.inputs); c++) {
        for (var a = 0; a < s.kernel.x; a++) {
            for (var b = 0; b < s.kernel.y; b++) {
                for (var d = 0; d < s.kernel.z; d++) {
                    let at = to * s.stride - s.padding + vec3(a, b, d) * s.dilation;
                    if all(at >= vec3(0)) && all(at < s.extent) {
                        let w = (((o * i32(s.inputs) + c) * s.kernel.x + a) * s.kernel.y + b) * s.kernel.z + d;
                        sum += weight[w] * x[((c * s.extent.x + at.x) * s.extent.y + at.y) * s.extent.z + at.z];
                    }
                }
            }
        }
    }
    var addend = 0;
    if s.residual != 0u { addend = residual[i] * columns[2 * i32(s.outputs) + o]; }
    let y = requantise(join(sum, s.residual, s.relu, addend), columns[i32(s.outputs) + o]);
    out[i] = select(clamp8(y), y, s.wide != 0u);
}
