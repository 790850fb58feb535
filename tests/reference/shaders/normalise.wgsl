// Bytes to network input: image[y, x, c] - mean[c], zeros right and below. Blue first on both sides.
struct Shape { height: u32, width: u32, padded_height: u32, padded_width: u32 }

@group(0) @binding(0) var<storage, read> s: Shape;
@group(0) @binding(1) var<storage, read> image: array<u32>; // [height, width, 3], one number per byte
@group(0) @binding(2) var<storage, read_write> out: array<f32>; // [3, padded_height, padded_width]

const MEAN = array<f32, 3>(103.530, 116.280, 123.675);

@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) n: vec3<u32>) {
    let i = id.y * n.x * 64u + id.x;
    if i >= arrayLength(&out) { return; }
    let x = i % s.padded_width;
    let y = i / s.padded_width % s.padded_height;
    let c = i / (s.padded_width * s.padded_height);
    var value = 0.0;
    if y < s.height && x < s.width {
        var mean = MEAN;
        value = f32(image[(y * s.width + x) * 3u + c]) - mean[c];
    }
    out[i] = value;
}
