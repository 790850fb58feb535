// Convolution over three axes, cross-correlation as in PyTorch's Conv3d; an image has depth 1.
// out[o, p] = bias[o] + sum over i, tap of weight[o, i, tap] * x[i, p * stride - padding + tap * dilation], 0 outside x.
struct Shape {
    inputs: u32,
    outputs: u32,
    has_bias: u32,
    pad: u32,
    extent: vec3<i32>,
    output: vec3<i32>,
    kernel: vec3<i32>,
    stride: vec3<i32>,
    dilation: vec3<i32>,
    padding: vec3<i32>,
}

@group(0) @binding(0) var<storage, read> s: Shape;
@group(0) @binding(1) var<storage, read> x: array<f32>; // [inputs, extent]
@group(0) @binding(2) var<storage, read> weight: array<f32>; // [outputs, inputs, kernel]
@group(0) @binding(3) var<storage, read> bias: array<f32>; // [outputs], or one number that is not read
@group(0) @binding(4) var<storage, read_write> out: array<f32>; // [outputs, output]

@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) n: vec3<u32>) {
    let i = id.y * n.x * 64u + id.x;
    if i >= arrayLength(&out) { return; }
    let positions = s.output.x * s.output.y * s.output.z;
    let o = i32(i) / positions;
    let p = i32(i) % positions;
    let to = vec3(p / (s.output.y * s.output.z), p / s.output.z % s.output.y, p % s.output.z);
    var sum = 0.0;
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
    if s.has_bias != 0u { sum += bias[o]; }
    out[i] = sum;
}
