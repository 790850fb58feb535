// Transposed convolution in integers, 4x4x4, stride 2, padding 1: every input adds to the 64 outputs at 2 * position - 1 + tap.
struct Shape { inputs: u32, outputs: u32, residual: u32, relu: u32, extent: vec3<i32> }

@group(0) @binding(0) var<storage, read> s: Shape;
@group(0) @binding(1) var<storage, read> x: array<i32>; // [inputs, extent]
@group(0) @binding(2) var<storage, read> weight: array<i32>; // [inputs, outputs, 4, 4, 4]
@group(0) @binding(3) var<storage, read> columns: array<i32>; // [3, outputs]: bias, multiplier, the residual's multiplier
@group(0) @binding(4) var<storage, read> residual: array<i32>; // [outputs, 2 * extent], or one number that is not read
@group(0) @binding(5) var<storage, read_write> out: array<i32>; // [outputs, 2 * extent]

@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) n: vec3<u32>) {
    let i = id.y * n.x * 64u + id.x;
    if i >= arrayLength(&out) { return; }
    let size = 2 * s.extent;
    let positions = size.x * size.y * size.z;
    let o = i32(i) / positions;
    let p = i32(i) % positions;
    let to = vec3(p / (size.y * size.z), p / size.z % size.y, p % size.z);
    var sum = columns[o];
    for (var c = 0; c < i32(s.inputs); c++) {
        for (var tap = 0; tap < 64; tap++) {
            let twice = to + 1 - vec3(tap / 16, tap / 4 % 4, tap % 4);
            let at = twice / 2;
            if all(twice >= vec3(0)) && all(twice % 2 == vec3(0)) && all(at < s.extent) {
                sum += weight[(c * i32(s.outputs) + o) * 64 + tap]
                    * x[((c * s.extent.x + at.x) * s.extent.y + at.y) * s.extent.z + at.z];
            }
        }
    }
    var addend = 0;
    if s.residual != 0u { addend = residual[i] * columns[2 * i32(s.outputs) + o]; }
    out[i] = clamp8(requantise(join(sum, s.residual, s.relu, addend), columns[i32(s.outputs) + o]));
}
