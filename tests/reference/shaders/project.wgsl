// Where a sample point lands in a camera: its flat feature pixel, or 0 where it hits none.
// p = matrix * (x, y, z, 1); u = p0 / p2, v = p1 / p2; valid if 0 <= u <= width - 1, 0 <= v <= height - 1, p2 >= 0.
// The pixel is (floor(u / stride), floor(v / stride)), its index camera * pixels + v * columns + u. Index 0 never counts.
struct Shape { points: vec3<u32>, cameras: u32, height: u32, width: u32, stride: u32, pad: u32 }

@group(0) @binding(0) var<storage, read> s: Shape;
@group(0) @binding(1) var<storage, read> axes: array<f32>; // x, then y, then z coordinates
@group(0) @binding(2) var<storage, read> matrices: array<f32>; // [cameras, 4, 4]
@group(0) @binding(3) var<storage, read_write> out: array<u32>; // [cameras, x, y, z]

fn row(camera: u32, r: u32, p: vec3<f32>) -> f32 {
    let m = camera * 16u + r * 4u;
    return matrices[m] * p.x + matrices[m + 1u] * p.y + matrices[m + 2u] * p.z + matrices[m + 3u];
}

@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) n: vec3<u32>) {
    let i = id.y * n.x * 64u + id.x;
    if i >= arrayLength(&out) { return; }
    let z = i % s.points.z;
    let y = i / s.points.z % s.points.y;
    let x = i / (s.points.z * s.points.y) % s.points.x;
    let camera = i / (s.points.z * s.points.y * s.points.x);
    let p = vec3(axes[x], axes[s.points.x + y], axes[s.points.x + s.points.y + z]);
    let depth = row(camera, 2u, p);
    let u = row(camera, 0u, p) / depth;
    let v = row(camera, 1u, p) / depth;
    var hit = 0u;
    // With depth 0 u and v are infinite or NaN and fail.
    if depth >= 0.0 && u >= 0.0 && u <= f32(s.width - 1u) && v >= 0.0 && v <= f32(s.height - 1u) {
        let columns = s.width / s.stride;
        let flat = (camera * (s.height / s.stride) + u32(floor(v / f32(s.stride)))) * columns
            + u32(floor(u / f32(s.stride)));
        if flat > 0u { hit = flat; }
    }
    out[i] = hit;
}
