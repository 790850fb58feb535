//! AVX-VNNI on a CPU that lacks it. Such a CPU refuses the instruction, Linux makes a signal of that, and the signal's
//! handler carries the instruction out on the registers of what it interrupted. So the body of `avx2-vnni` runs as it is
//! compiled, if slowly. The handler stays for as long as the process lives.

mod instruction;
#[cfg(test)]
mod tests;

use crate::isa::{Avx2, Isa};
use instruction::{Address, Base, Instruction, Operand};
use std::cell::Cell;
use std::sync::OnceLock;

/// `avx2-vnni`, where the CPU has AVX2 and lacks AVX-VNNI.
pub(super) fn avx2_vnni() -> Option<Isa> {
    static HANDLES: OnceLock<()> = OnceLock::new();
    let mut tokens = Avx2::detect();
    let (Some(plain), None) = (tokens.next(), tokens.next()) else { return None };
    HANDLES.get_or_init(|| {
        PARTS.get_or_init(Parts::new);
        handle();
    });
    // SAFETY: from now on the process has the handler of `vpdpbusd`, the only instruction of AVX-VNNI that kernels use.
    Some(Isa::Avx2(unsafe { plain.with_vnni() }))
}

thread_local! {
    static CARRIED_OUT: Cell<u64> = const { Cell::new(0) };
}

/// How many instructions of this thread were carried out.
pub fn carried_out() -> u64 {
    CARRIED_OUT.get()
}

/// Where parts of the vector registers lie in what XSAVE stores, which is the form of a signal's context.
struct Parts {
    /// Of each register the second 128 bits.
    high: usize,
    /// Of each register the second 256 bits.
    upper: usize,
}

static PARTS: OnceLock<Parts> = OnceLock::new();

/// Where of each register the first 128 bits lie.
const LOW: usize = 160;
/// Where a word says which parts are stored; those that are not are zero. The constants below are its bits.
const STORED: usize = 512;
const LOW_STORED: u32 = 1;
const HIGH_STORED: u32 = 2;
const UPPER_STORED: u32 = 6;

impl Parts {
    fn new() -> Self {
        #[allow(unused_unsafe, reason = "older compilers want it")]
        // SAFETY: every x86-64 CPU has CPUID, and one with AVX this leaf.
        let offset = |part| unsafe { std::arch::x86_64::__cpuid_count(0xd, part) }.ebx as usize;
        Self { high: offset(HIGH_STORED), upper: offset(UPPER_STORED) }
    }
}

/// Makes [`carry_out`] the handler of illegal instructions.
fn handle() {
    // SAFETY: zero is a valid value of every field.
    let mut action: libc::sigaction = unsafe { std::mem::zeroed() };
    action.sa_sigaction = carry_out as *const () as usize;
    action.sa_flags = libc::SA_SIGINFO;
    // SAFETY: the handler has the type that SA_SIGINFO asks for, and does nothing that a handler may not.
    let done = unsafe { libc::sigaction(libc::SIGILL, &action, std::ptr::null_mut()) };
    assert_eq!(done, 0, "no handler of illegal instructions: {}", std::io::Error::last_os_error());
}

/// Carries out the instruction that was refused, and those that follow as long as they are `vpdpbusd` too. Any other
/// instruction ends the process, as without a handler.
extern "C" fn carry_out(_: libc::c_int, _: *mut libc::siginfo_t, context: *mut libc::c_void) {
    // SAFETY: the system passes the context of what was interrupted, which is the handler's until it returns.
    let context = unsafe { &mut (*context.cast::<libc::ucontext_t>()).uc_mcontext };
    let mut vectors = Vectors { area: context.fpregs.cast() };
    let mut count = 0;
    loop {
        let at = context.gregs[libc::REG_RIP as usize];
        let code = std::ptr::with_exposed_provenance::<u8>(at as usize);
        // SAFETY: the CPU came to this instruction, and `decode` reads no byte that is not the instruction's.
        let bytes = (0..).map(|i| unsafe { code.add(i).read() });
        let Some(instruction) = Instruction::decode(bytes) else { break };
        context.gregs[libc::REG_RIP as usize] += i64::from(instruction.length);
        // SAFETY: `area` is what the system stored of a CPU with AVX, and the instruction may read the memory that it
        // names: where it may not, it would have ended the process, as reading here does.
        unsafe { execute(instruction, &mut vectors, &context.gregs) };
        count += 1;
    }
    if count == 0 {
        // SAFETY: this is the default action of a signal; the instruction will be met again.
        unsafe { libc::signal(libc::SIGILL, libc::SIG_DFL) };
    }
    CARRIED_OUT.set(CARRIED_OUT.get() + count);
}

/// # Safety
/// What [`Vectors`] holds must be an area of XSAVE, `general` registers that point to what the instruction may read.
unsafe fn execute(instruction: Instruction, vectors: &mut Vectors, general: &[libc::greg_t; 23]) {
    let Instruction { width, sums, unsigned, signed, .. } = instruction;
    let mut w = [0; 32];
    match signed {
        // SAFETY: the caller promises the area.
        Operand::Register(n) => w = unsafe { vectors.get(n) },
        Operand::Memory(address) => {
            let from = std::ptr::with_exposed_provenance::<u8>(resolve(address, general) as usize);
            // SAFETY: the caller promises that the instruction may read there; `w` has room for the widest.
            unsafe { std::ptr::copy_nonoverlapping(from, w.as_mut_ptr(), width) };
        }
    }
    // SAFETY: the caller promises the area.
    let (sum, a) = unsafe { (vectors.get(sums), vectors.get(unsigned)) };
    let (sum, a, w): ([i32; 8], [[u8; 4]; 8], [[i8; 4]; 8]) =
        (bytemuck::cast(sum), bytemuck::cast(a), bytemuck::cast(w));
    // What is beyond the width is zero.
    let lanes: [i32; 8] =
        std::array::from_fn(|lane| if 4 * lane < width { dot(sum[lane], a[lane], w[lane]) } else { 0 });
    // SAFETY: as above.
    unsafe { vectors.set(sums, bytemuck::cast(lanes)) };
}

/// Four products added to a sum, modulo 2^32.
fn dot(sum: i32, a: [u8; 4], w: [i8; 4]) -> i32 {
    (0..4).fold(sum, |sum, i| sum.wrapping_add(i32::from(a[i]) * i32::from(w[i])))
}

/// The places in a context of the general registers, by their numbers in instructions.
const GENERAL: [libc::c_int; 16] = {
    use libc::*;
    [
        REG_RAX, REG_RCX, REG_RDX, REG_RBX, REG_RSP, REG_RBP, REG_RSI, REG_RDI, REG_R8, REG_R9, REG_R10, REG_R11,
        REG_R12, REG_R13, REG_R14, REG_R15,
    ]
};

/// The address, once the instruction pointer is that of the instruction that follows.
fn resolve(Address { base, index, displacement }: Address, general: &[libc::greg_t; 23]) -> i64 {
    let register = |n: usize| general[GENERAL[n] as usize];
    let base = match base {
        Base::None => 0,
        Base::Register(n) => register(n),
        Base::Next => general[libc::REG_RIP as usize],
    };
    let index = index.map_or(0, |(n, shift)| register(n) << shift);
    base.wrapping_add(index).wrapping_add(displacement.into())
}

/// The vector registers of what was interrupted.
struct Vectors {
    area: *mut u8,
}

impl Vectors {
    /// The sixteen registers' part at `offset`, stored if bit `stored` is set, and otherwise from now on.
    ///
    /// # Safety
    /// `area` must be one of XSAVE that has the part.
    unsafe fn part(&mut self, offset: usize, stored: u32) -> *mut [u8; 16] {
        // SAFETY: both are inside the area, which is aligned to 64 bytes.
        unsafe {
            let part = self.area.add(offset).cast::<[u8; 16]>();
            let flags = self.area.add(STORED).cast::<u64>();
            if *flags >> stored & 1 == 0 {
                part.write_bytes(0, 16);
                *flags |= 1 << stored;
            }
            part
        }
    }

    /// # Safety
    /// `area` must be one of XSAVE with AVX.
    unsafe fn get(&mut self, n: usize) -> [u8; 32] {
        let high = PARTS.get().expect("set before the handler").high;
        // SAFETY: the caller promises the area, and there are sixteen registers.
        let halves = unsafe { [*self.part(LOW, LOW_STORED).add(n), *self.part(high, HIGH_STORED).add(n)] };
        bytemuck::cast(halves)
    }

    /// Writes the register, whose bits beyond 256 become zero.
    ///
    /// # Safety
    /// `area` must be one of XSAVE with AVX.
    unsafe fn set(&mut self, n: usize, value: [u8; 32]) {
        let &Parts { high, upper } = PARTS.get().expect("set before the handler");
        let halves: [[u8; 16]; 2] = bytemuck::cast(value);
        // SAFETY: the caller promises the area, and there are sixteen registers. A flag tells whether AVX-512's part is there.
        unsafe {
            *self.part(LOW, LOW_STORED).add(n) = halves[0];
            *self.part(high, HIGH_STORED).add(n) = halves[1];
            if *self.area.add(STORED).cast::<u64>() >> UPPER_STORED & 1 == 1 {
                *self.area.add(upper).cast::<[u8; 32]>().add(n) = [0; 32];
            }
        }
    }
}
