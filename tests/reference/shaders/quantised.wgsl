// Precedes every shader whose name ends in _i8. Numbers are i32, those of 8-bit tensors within -127..=127.

// The product of two numbers without sign: the upper and the lower 32 bits, from products of halves.
fn product(a: u32, b: u32) -> vec2<u32> {
    let low = (a & 0xffffu) * (b & 0xffffu);
    let mixed = (a >> 16u) * (b & 0xffffu) + (low >> 16u);
    let middle = (a & 0xffffu) * (b >> 16u) + (mixed & 0xffffu);
    return vec2((a >> 16u) * (b >> 16u) + (mixed >> 16u) + (middle >> 16u), (middle << 16u) | (low & 0xffffu));
}

fn magnitude(x: i32) -> u32 {
    return select(bitcast<u32>(x), 0u - bitcast<u32>(x), x < 0);
}

// sum * multiplier / 2^32, to the nearest integer, halves upwards; multiplier is not negative.
fn requantise(sum: i32, multiplier: i32) -> i32 {
    let p = product(magnitude(sum), bitcast<u32>(multiplier));
    if sum >= 0 { return bitcast<i32>(p.x + (p.y >> 31u)); }
    // Exactly a half below zero goes to the smaller magnitude.
    return -bitcast<i32>(p.x + select(0u, 1u, p.y > 0x80000000u));
}

fn clamp8(x: i32) -> i32 {
    return clamp(x, -127, 127);
}

// What joins a sum: 0 nothing, 1 an addend and then ReLU, 2 the addend after ReLU.
fn join(sum: i32, how: u32, relu: u32, addend: i32) -> i32 {
    var x = sum;
    if how == 1u { x += addend; }
    if relu != 0u { x = max(x, 0); }
    if how == 2u { x += addend; }
    return x;
}
