//! The instruction against what its manual says, in every form of operands that compilers give it. On a CPU that has
//! AVX-VNNI the CPU is compared; the decoder is tested everywhere.

use super::carried_out;
use super::instruction::{Address, Base, Instruction, Operand};
use crate::cases::{Memory, isas};
use crate::isa::{Avx2, Avx512, Isa};
use crate::testing::Rng;
use std::arch::asm;
use std::arch::x86_64::__m256i;
use std::io::Write as _;

/// Sums, unsigned bytes and signed bytes.
#[derive(Clone, Copy)]
struct Operands {
    sums: [i32; 8],
    a: [u8; 32],
    w: [i8; 32],
}

/// Operands at the ends of their ranges, then drawn ones.
fn operands() -> Vec<Operands> {
    let mut rng = Rng::new(7);
    let mut all = vec![
        Operands { sums: [i32::MAX; 8], a: [255; 32], w: [127; 32] },
        Operands { sums: [i32::MIN; 8], a: [255; 32], w: [-128; 32] },
        Operands { sums: [0, 1, -1, i32::MAX, i32::MIN, 130_560, -130_560, 7], a: [128; 32], w: [-128; 32] },
    ];
    all.extend((0..20).map(|_| Operands {
        sums: std::array::from_fn(|_| rng.bits() as i32),
        a: std::array::from_fn(|_| rng.bits() as u8),
        w: std::array::from_fn(|_| rng.bits() as i8),
    }));
    all
}

/// The instruction's definition, in numbers that nothing overflows.
fn want(Operands { sums, a, w }: Operands) -> [i32; 8] {
    std::array::from_fn(|lane| {
        let products = (4 * lane..4 * lane + 4).map(|i| i64::from(a[i]) * i64::from(w[i]));
        (i64::from(sums[lane]) + products.sum::<i64>()) as i32
    })
}

#[test]
fn by_hand() {
    let sums = |sum, a, w| want(Operands { sums: [sum; 8], a: [a; 32], w: [w; 32] });
    // Neither the products nor the sums saturate, and bytes from 128 on are not negative on the left.
    assert_eq!(sums(5, 255, 127), [129_545; 8]);
    assert_eq!(sums(5, 255, -128), [-130_555; 8]);
    assert_eq!(sums(i32::MAX, 1, 1), [i32::MIN + 3; 8]);
    assert_eq!(sums(i32::MIN, 200, -1), [i32::MAX - 799; 8]);
}

/// Functions that execute the instruction in some form, each with the registers of its sums and unsigned bytes, then with
/// those of the signed bytes or their address.
macro_rules! forms {
    (with $w:ident and $at:ident; $($name:ident: $code:literal, $sums:tt, $a:tt, [$($operand:tt)*];)*) => {
        $(
            /// # Safety
            /// The process must execute the instruction. The form must be able to read from its address on.
            #[target_feature(enable = "avx2")]
            unsafe fn $name(mut sums: __m256i, a: __m256i, $w: __m256i, $at: usize) -> __m256i {
                let _ = ($w, $at);
                // SAFETY: the caller promises the instruction and its memory. What it changes is declared.
                unsafe { asm!($code, inout($sums) sums, in($a) a, $($operand)*) };
                sums
            }
        )*
    };
}

/// Beyond the displacements of the forms below.
const FAR: usize = 0x1234;

/// Read by the form whose address is that of the code.
static HERE: [i8; 32] = [
    -128, 127, 3, -3, 1, 2, 5, -7, 9, 11, -13, 17, 19, -23, 29, 31, 0, 37, -41, 43, 47, -53, 59, 61, 67, -71, 73, 79,
    -83, 89, 97, 101,
];

forms! {
    with w and at;
    low: "{{vex}} vpdpbusd ymm0, ymm1, ymm2", "ymm0", "ymm1", [in("ymm2") w];
    high: "{{vex}} vpdpbusd ymm15, ymm8, ymm9", "ymm15", "ymm8", [in("ymm9") w];
    mixed: "{{vex}} vpdpbusd ymm3, ymm14, ymm5", "ymm3", "ymm14", [in("ymm5") w];
    crossed: "{{vex}} vpdpbusd ymm12, ymm7, ymm4", "ymm12", "ymm7", [in("ymm4") w];
    base: "{{vex}} vpdpbusd ymm6, ymm2, [rax]", "ymm6", "ymm2", [in("rax") at];
    base_as_frame: "{{vex}} vpdpbusd ymm6, ymm2, [r13]", "ymm6", "ymm2", [in("r13") at];
    base_as_stack: "{{vex}} vpdpbusd ymm9, ymm12, [r12]", "ymm9", "ymm12", [in("r12") at];
    back: "{{vex}} vpdpbusd ymm9, ymm2, [rdi - 128]", "ymm9", "ymm2", [in("rdi") at + 128];
    far: "{{vex}} vpdpbusd ymm1, ymm0, [r15 + {far}]", "ymm1", "ymm0", [in("r15") at.wrapping_sub(FAR), far = const FAR];
    indexed: "{{vex}} vpdpbusd ymm1, ymm0, [rcx + 4*r10 - 64]", "ymm1", "ymm0", [in("rcx") at, in("r10") 16usize];
    indexed_by_twelve: "{{vex}} vpdpbusd ymm1, ymm0, [r13 + 2*r12]", "ymm1", "ymm0", [in("r13") at + 6, in("r12") -3isize];
    indexed_far: "{{vex}} vpdpbusd ymm10, ymm11, [r8 + rdx + {far}]", "ymm10", "ymm11", [in("r8") at, in("rdx") -(FAR as isize),
        far = const FAR];
    index_alone: "{{vex}} vpdpbusd ymm10, ymm11, [8*rsi + 16]", "ymm10", "ymm11", [in("rsi") at / 8 - 2];
    frame: "push rbp\nmov rbp, {at}\n{{vex}} vpdpbusd ymm1, ymm2, [rbp]\npop rbp", "ymm1", "ymm2", [at = in(reg) at];
    stack: "sub rsp, 256\nvmovdqu [rsp + 40], ymm3\n{{vex}} vpdpbusd ymm4, ymm5, [rsp + 40]\nadd rsp, 256", "ymm4", "ymm5",
        [in("ymm3") w];
    short: "{{vex}} vpdpbusd xmm4, xmm13, xmm14", "ymm4", "ymm13", [in("ymm14") w];
    short_memory: "{{vex}} vpdpbusd xmm11, xmm5, [r9 + 8]", "ymm11", "ymm5", [in("r9") at - 8];
    fixed: "{{vex}} vpdpbusd ymm8, ymm3, [rip + {here}]", "ymm8", "ymm3", [here = sym HERE];
    run: "{{vex}} vpdpbusd ymm2, ymm3, ymm4\n{{vex}} vpdpbusd ymm2, ymm3, [r11 - 1]\nvpaddd ymm2, ymm2, ymm4\n\
          vpsubd ymm2, ymm2, ymm4\n{{vex}} vpdpbusd ymm2, ymm3, ymm4", "ymm2", "ymm3", [in("ymm4") w, in("r11") at + 1];
}

/// A form, how many bytes it reads from memory at most, and what it should give.
type Form = (Execute, usize, fn(Operands) -> [i32; 8]);
type Execute = unsafe fn(__m256i, __m256i, __m256i, usize) -> __m256i;

/// Every form.
fn forms() -> Vec<Form> {
    let plain: [Execute; 4] = [low, high, mixed, crossed];
    let memory: [Execute; 11] = [
        base,
        base_as_stack,
        base_as_frame,
        frame,
        stack,
        back,
        far,
        indexed,
        indexed_by_twelve,
        indexed_far,
        index_alone,
    ];
    let wide = plain.into_iter().chain(memory).map(|form| (form, 32, want as _));
    let half: fn(Operands) -> [i32; 8] = |of| {
        let sums = want(of);
        std::array::from_fn(|lane| if lane < 4 { sums[lane] } else { 0 })
    };
    let others: [Form; 4] = [
        (short, 16, half),
        (short_memory, 16, half),
        (fixed, 0, |of| want(Operands { w: HERE, ..of })),
        (run, 32, |of| (0..3).fold(of, |of, _| Operands { sums: want(of), ..of }).sums),
    ];
    wide.chain(others).collect()
}

/// Executes a form on memory that ends `behind` bytes behind what it reads.
fn execute((form, reads, _): Form, of: Operands, behind: usize) -> [i32; 8] {
    let held = Memory::Back.hold(&[&of.w[..reads], &vec![99; behind]].concat());
    let at = held.as_ptr().expose_provenance();
    let [sums, a, w] = [bytemuck::cast(of.sums), of.a, bytemuck::cast::<_, [u8; 32]>(of.w)].map(|bytes| {
        // SAFETY: any bits are a vector.
        unsafe { std::mem::transmute::<[u8; 32], __m256i>(bytes) }
    });
    // SAFETY: the caller has asked for the instruction, and `reads` bytes from `at` on can be read.
    let sums = unsafe { form(sums, a, w, at) };
    // SAFETY: any bits are integers.
    unsafe { std::mem::transmute(sums) }
}

/// Whether the process executes the instruction, and whether it is the handler that does.
fn executes() -> Option<bool> {
    let isa = isas().find(|isa| isa.name() == "avx2-vnni");
    let handled = isa.map(|isa| Isa::parse(isa.name()).is_err());
    let what = match handled {
        Some(true) => "a signal handler carries vpdpbusd out",
        Some(false) => "the CPU executes vpdpbusd",
        None => "without AVX2 there is no vpdpbusd",
    };
    // Not `eprintln`, which the harness would keep to itself.
    writeln!(std::io::stderr(), "{what}").expect("standard error");
    assert_eq!(handled.is_none(), Avx2::detect().next().is_none(), "with AVX2 there is vpdpbusd");
    handled
}

#[test]
fn every_form_gives_the_definition() {
    let Some(handled) = executes() else { return };
    let before = carried_out();
    let mut count = 0;
    for of in operands() {
        for (i, form) in forms().into_iter().enumerate() {
            // With addresses that are multiples of 32, and that are not.
            for behind in [0, 8] {
                assert_eq!(execute(form, of, behind), form.2(of), "form {i}, {behind} bytes behind");
            }
            count += 2 * if std::ptr::fn_addr_eq(form.0, run as Execute) { 3 } else { 1 };
        }
    }
    assert_eq!(carried_out() - before, if handled { count } else { 0 });
}

/// As of every instruction in this encoding.
#[test]
fn bits_beyond_256_become_zero() {
    #[target_feature(enable = "avx512f")]
    unsafe fn upper() -> [u8; 32] {
        let mut upper = [1; 32];
        // SAFETY: the caller promises AVX-512 and the instruction; what changes is declared.
        unsafe {
            asm!("vpternlogd zmm5, zmm5, zmm5, 255", "{{vex}} vpdpbusd ymm5, ymm5, ymm5", "vextracti64x4 ymm5, zmm5, 1",
                "vmovdqu [{to}], ymm5", to = in(reg) &mut upper, out("zmm5") _);
        }
        upper
    }
    if executes().is_some() && Avx512::detect().next().is_some() {
        // SAFETY: both have been asked for.
        assert_eq!(unsafe { upper() }, [0; 32]);
    }
}

/// A process that comes to any other illegal instruction ends by its signal.
#[test]
fn other_illegal_instructions_end_the_process() {
    executes();
    // SAFETY: the child does nothing but to end itself.
    let child = unsafe { libc::fork() };
    if child == 0 {
        // SAFETY: an illegal instruction and the call behind it come back to nobody.
        unsafe { asm!("ud2", "mov edi, 0", "mov eax, 60", "syscall", options(noreturn)) };
    }
    let mut status = 0;
    // SAFETY: `status` is writable.
    assert_eq!(unsafe { libc::waitpid(child, &mut status, 0) }, child);
    assert!(libc::WIFSIGNALED(status) && libc::WTERMSIG(status) == libc::SIGILL, "status {status:x}");
}

#[test]
fn operands_are_read_from_the_encoding() {
    let decode = |code: &[u8]| Instruction::decode(code.iter().copied());
    let memory = |base, index, displacement| Operand::Memory(Address { base, index, displacement });
    let of = |length, width, sums, unsigned, signed| Some(Instruction { length, width, sums, unsigned, signed });
    let cases: [(&[u8], _); 8] = [
        // ymm1, ymm2, ymm3
        (&[0xc4, 0xe2, 0x6d, 0x50, 0xcb], of(5, 32, 1, 2, Operand::Register(3))),
        // xmm9, xmm10, xmm11
        (&[0xc4, 0x42, 0x29, 0x50, 0xcb], of(5, 16, 9, 10, Operand::Register(11))),
        // ymm1, ymm2, [rbp]
        (&[0xc4, 0xe2, 0x6d, 0x50, 0x4d, 0x00], of(6, 32, 1, 2, memory(Base::Register(5), None, 0))),
        // ymm1, ymm2, [rsp - 8]
        (&[0xc4, 0xe2, 0x6d, 0x50, 0x4c, 0x24, 0xf8], of(7, 32, 1, 2, memory(Base::Register(4), None, -8))),
        // ymm1, ymm2, [rip - 2]
        (&[0xc4, 0xe2, 0x6d, 0x50, 0x0d, 0xfe, 0xff, 0xff, 0xff], of(9, 32, 1, 2, memory(Base::Next, None, -2))),
        // ymm1, ymm2, [r13 + 8 * r12 + 256]
        (
            &[0xc4, 0x82, 0x6d, 0x50, 0x8c, 0xe5, 0x00, 0x01, 0x00, 0x00],
            of(10, 32, 1, 2, memory(Base::Register(13), Some((12, 3)), 256)),
        ),
        // ymm1, ymm2, [2 * rbp + 16]
        (
            &[0xc4, 0xe2, 0x6d, 0x50, 0x0c, 0x6d, 0x10, 0x00, 0x00, 0x00],
            of(10, 32, 1, 2, memory(Base::None, Some((5, 1)), 16)),
        ),
        // ymm1, ymm2, [rax + rcx]
        (&[0xc4, 0xe2, 0x6d, 0x50, 0x0c, 0x08], of(6, 32, 1, 2, memory(Base::Register(0), Some((1, 0)), 0))),
    ];
    for (code, want) in cases {
        assert_eq!(decode(code), want, "{code:02x?}");
        // Nothing behind it is read, and without its end it is none.
        assert_eq!(decode(&[code, &[0xc4]].concat()), want);
        for end in 0..code.len() {
            assert_eq!(decode(&code[..end]), None, "{:02x?}", &code[..end]);
        }
    }
    // vpdpbusds, vpdpwssd; other prefixes, maps and forms; other encodings of vpdpbusd and of nothing.
    let others: [&[u8]; 8] = [
        &[0xc4, 0xe2, 0x6d, 0x51, 0xcb],
        &[0xc4, 0xe2, 0x6d, 0x52, 0xcb],
        &[0xc4, 0xe2, 0x6f, 0x50, 0xcb],
        &[0xc4, 0xe3, 0x6d, 0x50, 0xcb],
        &[0xc4, 0xe2, 0xed, 0x50, 0xcb],
        &[0xc5, 0xe2, 0x6d, 0x50, 0xcb],
        &[0x62, 0xf2, 0x6d, 0x28, 0x50, 0xcb],
        &[0x0f, 0x0b],
    ];
    for code in others {
        assert_eq!(decode(code), None, "{code:02x?}");
    }
}
