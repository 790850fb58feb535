// The mean over all positions, times a factor in units of 2^-24, to the nearest integer, halves upwards.
struct Shape { channels: u32, positions: u32 }

@group(0) @binding(0) var<storage, read> s: Shape;
@group(0) @binding(1) var<storage, read> x: array<i32>; // [channels, positions]
@group(0) @binding(2) var<storage, read> factor: array<i32>; // [1]
@group(0) @binding(3) var<storage, read_write> out: array<i32>; // [channels]

// Whether a <= b, of upper and lower halves.
fn at_most(a: vec2<u32>, b: vec2<u32>) -> bool {
    return a.x < b.x || (a.x == b.x && a.y <= b.y);
}

// a + b
fn plus(a: vec2<u32>, b: vec2<u32>) -> vec2<u32> {
    let low = a.y + b.y;
    return vec2(a.x + b.x + select(0u, 1u, low < a.y), low);
}

// A number of positions times 2^bits, for bits from 1 to 31.
fn shifted(positions: u32, bits: u32) -> vec2<u32> {
    return vec2(positions >> (32u - bits), positions << bits);
}

@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) n: vec3<u32>) {
    let i = id.y * n.x * 64u + id.x;
    if i >= arrayLength(&out) { return; }
    var sum = 0;
    for (var p = 0u; p < s.positions; p++) { sum += x[i * s.positions + p]; }
    // The quotient of |sum| * factor by positions * 2^24 is below 1024. Rounded: the largest q for which
    // q * positions * 2^24 is at most |sum| * factor and half a unit; below zero a half goes to the smaller magnitude.
    let exact = product(magnitude(sum), bitcast<u32>(factor[0]));
    var reach = plus(exact, shifted(s.positions, 23u));
    if sum < 0 { reach = plus(reach, vec2(0xffffffffu)); }
    var q = 0u;
    for (var bit = 512u; bit > 0u; bit /= 2u) {
        // q * positions may exceed 32 bits before the shift.
        let whole = product(q + bit, s.positions);
        let unit = vec2((whole.x << 24u) | (whole.y >> 8u), whole.y << 24u);
        if at_most(unit, reach) { q += bit; }
    }
    out[i] = clamp8(select(i32(q), -i32(q), sum < 0));
}
