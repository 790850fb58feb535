//! `vpdpbusd` in the encoding of AVX-VNNI, out of its bytes.

/// The instruction and where its operands are.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Instruction {
    /// Bytes of the encoding.
    pub(super) length: u8,
    /// Bytes of a vector: 16 or 32.
    pub(super) width: usize,
    /// The vector register of the sums, which is the result's.
    pub(super) sums: usize,
    /// That of the unsigned bytes.
    pub(super) unsigned: usize,
    pub(super) signed: Operand,
}

/// Where the signed bytes are.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Operand {
    /// In a vector register.
    Register(usize),
    /// In memory.
    Memory(Address),
}

/// `base + (index << shift) + displacement`: general registers by their numbers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Address {
    pub(super) base: Base,
    pub(super) index: Option<(usize, u32)>,
    pub(super) displacement: i32,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Base {
    None,
    Register(usize),
    /// The address of the instruction that follows.
    Next,
}

/// The register number that stands for another form of address.
const STACK: u8 = 4;
/// The register number that, without a displacement, stands for none.
const FRAME: u8 = 5;

impl Instruction {
    /// Reads no more of `code` than the instruction has, or than shows that it is another.
    pub(super) fn decode(mut code: impl Iterator<Item = u8>) -> Option<Self> {
        let mut length = 0;
        let mut next = || {
            length += 1;
            code.next()
        };
        // VEX in three bytes. What it says of registers is inverted.
        if next()? != 0xc4 {
            return None;
        }
        let (first, second) = (next()?, next()?);
        let extended = |bit: u8| usize::from(!first >> bit & 1) << 3;
        let (more_register, more_index, more_base) = (extended(7), extended(6), extended(5));
        // The opcodes that begin with 0f 38; a prefix of 66, and the form of W = 0.
        if first & 0x1f != 2 || second & 0x83 != 1 || next()? != 0x50 {
            return None;
        }
        let form = next()?;
        let signed = match (form >> 6, form & 7) {
            (3, register) => Operand::Register(usize::from(register) | more_base),
            (size, place) => {
                let (mut base, mut index) = (place, None);
                if place == STACK {
                    let scaled = next()?;
                    base = scaled & 7;
                    let register = usize::from(scaled >> 3 & 7) | more_index;
                    // The stack pointer is no index; register 12 is.
                    index = (register != usize::from(STACK)).then_some((register, u32::from(scaled >> 6)));
                }
                let bare = size == 0 && base == FRAME;
                let displacement = match size {
                    1 => i32::from(next()?.cast_signed()),
                    _ if size == 2 || bare => i32::from_le_bytes([next()?, next()?, next()?, next()?]),
                    _ => 0,
                };
                let base = match (bare, place) {
                    (true, FRAME) => Base::Next,
                    (true, _) => Base::None,
                    _ => Base::Register(usize::from(base) | more_base),
                };
                Operand::Memory(Address { base, index, displacement })
            }
        };
        Some(Self {
            length,
            width: if second & 4 == 0 { 16 } else { 32 },
            sums: usize::from(form >> 3 & 7) | more_register,
            unsigned: usize::from(!second >> 3 & 15),
            signed,
        })
    }
}
