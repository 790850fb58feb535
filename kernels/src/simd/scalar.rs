//! The scalar instruction set: it has no vectors, and runs the specification.

use super::Kernel;

/// Runs the specification, compiled so that `f32::mul_add` is the CPU's instruction if it has one. Compiled for any x86-64
/// it is a call of the C library per multiply-add. Both round once, so the bits are the same; nothing else changes.
#[inline]
pub(crate) fn run<K: Kernel>(kernel: K) -> K::Output {
    #[cfg(target_arch = "x86_64")]
    if crate::isa::has!("fma") {
        #[target_feature(enable = "fma")]
        fn with_fma<K: Kernel>(kernel: K) -> K::Output {
            kernel.reference()
        }
        // SAFETY: this CPU has FMA.
        return unsafe { with_fma(kernel) };
    }
    kernel.reference()
}
