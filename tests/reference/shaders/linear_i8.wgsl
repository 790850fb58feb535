// A linear layer in integers at every position. A hidden layer has ReLU and ends in 8 bits; the last one keeps its sums.
struct Shape { inputs: u32, outputs: u32, positions: u32, last: u32 }

@group(0) @binding(0) var<storage, read> s: Shape;
@group(0) @binding(1) var<storage, read> x: array<i32>; // [inputs, positions]
@group(0) @binding(2) var<storage, read> weight: array<i32>; // [outputs, inputs]
@group(0) @binding(3) var<storage, read> columns: array<i32>; // [2, outputs]: bias, multiplier
@group(0) @binding(4) var<storage, read_write> out: array<i32>; // hidden: [outputs, positions]; last: [positions, outputs]

@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) n: vec3<u32>) {
    let i = id.y * n.x * 64u + id.x;
    if i >= arrayLength(&out) { return; }
    let o = i / s.positions;
    let p = i % s.positions;
    var sum = columns[o];
    for (var c = 0u; c < s.inputs; c++) { sum += weight[o * s.inputs + c] * x[c * s.positions + p]; }
    if s.last != 0u {
        out[p * s.outputs + o] = sum;
    } else {
        out[i] = clamp8(requantise(max(sum, 0), columns[s.outputs + o]));
    }
}
