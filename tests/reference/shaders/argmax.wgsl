// The first of the largest logits of each voxel.
struct Shape { classes: u32 }

@group(0) @binding(0) var<storage, read> s: Shape;
@group(0) @binding(1) var<storage, read> logits: array<f32>; // [voxels, classes]
@group(0) @binding(2) var<storage, read_write> out: array<u32>; // [voxels]

@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) n: vec3<u32>) {
    let i = id.y * n.x * 64u + id.x;
    if i >= arrayLength(&out) { return; }
    var best = 0u;
    for (var c = 1u; c < s.classes; c++) {
        if logits[i * s.classes + c] > logits[i * s.classes + best] { best = c; }
    }
    out[i] = best;
}
