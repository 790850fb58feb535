// One head of attention within windows: softmax over the window's tokens of q . k / sqrt(dim) + offset[|dy|, |dx|], times v.
struct Shape { dim: u32, height: u32, width: u32, window_height: u32, window_width: u32, side: u32 }

@group(0) @binding(0) var<storage, read> s: Shape;
@group(0) @binding(1) var<storage, read> q: array<f32>; // [dim, height, width]
@group(0) @binding(2) var<storage, read> k: array<f32>;
@group(0) @binding(3) var<storage, read> v: array<f32>;
@group(0) @binding(4) var<storage, read> offset: array<f32>; // [side, side]
@group(0) @binding(5) var<storage, read_write> out: array<f32>; // [dim, height, width]

fn score(y: u32, x: u32, other_y: u32, other_x: u32) -> f32 {
    let plane = s.height * s.width;
    var dot = 0.0;
    for (var d = 0u; d < s.dim; d++) {
        dot += q[d * plane + y * s.width + x] * k[d * plane + other_y * s.width + other_x];
    }
    let dy = max(y, other_y) - min(y, other_y);
    let dx = max(x, other_x) - min(x, other_x);
    return dot / sqrt(f32(s.dim)) + offset[dy * s.side + dx];
}

@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) n: vec3<u32>) {
    let i = id.y * n.x * 64u + id.x;
    if i >= arrayLength(&out) { return; }
    let x = i % s.width;
    let y = i / s.width % s.height;
    let d = i / (s.width * s.height);
    let top = y / s.window_height * s.window_height;
    let left = x / s.window_width * s.window_width;
    var largest = score(y, x, top, left);
    for (var a = 0u; a < s.window_height; a++) {
        for (var b = 0u; b < s.window_width; b++) { largest = max(largest, score(y, x, top + a, left + b)); }
    }
    var weights = 0.0;
    var sum = 0.0;
    for (var a = 0u; a < s.window_height; a++) {
        for (var b = 0u; b < s.window_width; b++) {
            let weight = exp(score(y, x, top + a, left + b) - largest);
            weights += weight;
            sum += weight * v[(d * s.height + top + a) * s.width + left + b];
        }
    }
    out[i] = sum / weights;
}
