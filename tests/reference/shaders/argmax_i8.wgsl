// The first of the largest sums of each voxel.
struct Shape { classes: u32 }

@group(0) @binding(0) var<storage, read> s: Shape;
@group(0) @binding(1) var<storage, read> sums: array<i32>; // [voxels, classes]
@group(0) @binding(2) var<storage, read_write> out: array<i32>; // [voxels]

@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) n: vec3<u32>) {
    let i = id.y * n.x * 64u + id.x;
    if i >= arrayLength(&out) { return; }
    var best = 0u;
    for (var c = 1u; c < s.classes; c++) {
        if sums[i * s.classes + c] > sums[i * s.classes + best] { best = c; }
    }
    out[i] = i32(best);
}
