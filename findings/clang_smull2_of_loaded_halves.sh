#!/usr/bin/env bash
# Clang compiles NEON's `vmull_high_s8` to `smull2` only if neither factor comes from memory.
#
# The intrinsic multiplies the upper halves of two registers, for which AArch64 has an instruction, and a product of bytes
# is written with it so that a load of 16 bytes serves two multiplications. But where one factor has just been loaded or
# broadcast, LLVM narrows that load to 8 bytes, and to reach the other factor's upper half it adds an `ext`, a permutation on the same
# pipes that multiply. What was one instruction is two, and the shifted copy takes one more register.
#
# Version: clang 20.1.2, as ziglang 0.15.2 has it, -O3 for aarch64. rustc 1.95.0 (LLVM 22.1) narrows such loads, too.
#
# In our product of bytes for processors without dot products the copies crowded out the sums: in llvm-mca's model a round took 51 cycles.
# It loads both halves by themselves now, and takes 34.
set -euo pipefail
work="$(mktemp -d)"
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet --disable-pip-version-check ziglang==0.15.2

cat >"$work/product.c" <<'C'
#include <arm_neon.h>
int16x8_t in_registers(int8x16_t w, int8x16_t a) { return vmull_high_s8(w, a); }
int16x8_t loaded(int8x16_t w, const int8_t *a) { return vmull_high_s8(w, vld1q_s8(a)); }
int16x8_t broadcast(int8x16_t w, const int32_t *a) { return vmull_high_s8(w, vreinterpretq_s8_s32(vdupq_n_s32(*a))); }
C
export ZIG_GLOBAL_CACHE_DIR="$work/cache" ZIG_LOCAL_CACHE_DIR="$work/cache"
"$work/venv/bin/python" -m ziglang clang --version | sed -n '1s/ (.*//p'
"$work/venv/bin/python" -m ziglang cc -target aarch64-linux-gnu -O3 -g0 -S "$work/product.c" -o "$work/product.s" 2>/dev/null
found="$(awk '/^[a-z_]+:/ { sub(":.*", ""); printf "%s%s:", (n++ ? "\n" : ""), $0 } /^\t(ext|ldr|ld1r|smull2?)\t/ { printf " %s", $1 } END { print "" }' \
    "$work/product.s")"
echo "$found"
[ "$found" = "in_registers: smull2
loaded: ext ldr smull
broadcast: ext ld1r smull" ]
