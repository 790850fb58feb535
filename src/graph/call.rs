//! What an operation is given when it runs: its tensors as typed slices, and one tile of its output at a time.
//!
//! All of it is plain borrowed data. Whoever makes it ([`crate::runtime`]) has made sure that nothing that is read is
//! written meanwhile.

use super::element::{Element, Elements, Scalar};
use super::matrices::Level;
use super::site::Site;
use std::ops::Range;
use voxcast_kernels::Isa;

/// Tensors that an operation reads beside its residual, at most.
pub const MAX_INPUTS: usize = 2;
/// Tensors that an operation writes, at most.
pub const MAX_OUTPUTS: usize = 4;

/// The tensor that is added to the result.
#[derive(Clone, Copy, Debug)]
pub enum Added<'a> {
    /// None.
    Nothing,
    /// It lies where the output goes, and is added before the ReLU.
    InPlace,
    /// It lies apart; all positions of it.
    Apart {
        /// Its elements.
        elements: Elements<'a>,
        /// Whether it is added after the ReLU instead of before.
        after: bool,
    },
}

/// What belongs to the frame rather than to the graph.
#[derive(Clone, Copy, Debug)]
pub struct Moment<'a> {
    /// Height and width of the camera's image, which lies dense at the start of its tensor. Zeros after all cameras.
    pub image: [usize; 2],
    /// The matrices of levels 1 to 3.
    pub levels: &'a [Level<'a>; 3],
    /// For each camera, whether it is left out.
    pub masked: &'a [bool],
}

/// Everything that an operation reads.
#[derive(Clone, Copy, Debug)]
pub struct Call<'a> {
    /// Instruction set of the kernel.
    pub isa: Isa,
    /// Where the operation stands.
    pub site: Site<'a>,
    /// Its inputs. One that the output overwrites is empty: the tile has it. An operation of a camera's pass sees its
    /// camera's copy of tensors that each camera has, one after all cameras sees the copies of all.
    pub inputs: [Elements<'a>; MAX_INPUTS],
    /// What is added.
    pub added: Added<'a>,
    /// Its stored parts, in the order of the description.
    pub parts: &'a [Elements<'a>],
    /// The frame.
    pub moment: Moment<'a>,
}

impl<'a> Call<'a> {
    /// Input `i`.
    ///
    /// # Panics
    /// If its elements are of another type.
    pub fn input<T: Scalar>(&self, i: usize) -> &'a [T] {
        self.inputs[i].of()
    }

    /// Stored part `i`.
    ///
    /// # Panics
    /// If its elements are of another type.
    pub fn part<T: Scalar>(&self, i: usize) -> &'a [T] {
        self.parts[i].of()
    }
}

/// Consecutive positions of the output, for one worker.
#[derive(Debug)]
pub struct Tile<'a> {
    /// Which positions.
    pub positions: Range<usize>,
    /// These positions of each output, all channels of them.
    pub(crate) outputs: [(Element, &'a mut [u8]); MAX_OUTPUTS],
    /// The worker's own, 64-byte aligned, of unknown content.
    pub(crate) scratch: &'a mut [u8],
}

impl<'a> Tile<'a> {
    /// The positions' elements of output `i`, once.
    ///
    /// # Panics
    /// If they are of another type.
    pub fn output<T: Scalar>(&mut self, i: usize) -> &'a mut [T] {
        let (element, bytes) = &mut self.outputs[i];
        assert_eq!(*element, T::ELEMENT, "output {i}");
        bytemuck::cast_slice_mut(std::mem::take(bytes))
    }

    /// The scratch as elements of type `T`, once.
    pub fn scratch<T: Scalar>(&mut self) -> &'a mut [T] {
        bytemuck::cast_slice_mut(std::mem::take(&mut self.scratch))
    }
}
