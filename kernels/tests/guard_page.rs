//! Kernels stay inside their slices: here every slice lies against memory that cannot be touched.
//!
//! A read or write of one number too many ends the process with a segmentation fault. Each kernel runs twice: with every
//! slice ending where an unreadable page begins, and with every slice beginning where one ends.
#![cfg(unix)]

use half::f16;
use std::ops::{Deref, DerefMut};
use std::ptr::NonNull;
use voxcast_kernels::conv::{Conv, Geometry, conv};
use voxcast_kernels::deconv3d::{Deconv3d, deconv3d};
use voxcast_kernels::deform_conv2d::{DeformConv2d, deform_conv2d};
use voxcast_kernels::depthwise::{Depthwise, depthwise};
use voxcast_kernels::gate::{Gate, gate};
use voxcast_kernels::gather::{Gather, Mask, gather};
use voxcast_kernels::head::{Head, head, scratch_len};
use voxcast_kernels::max_pool::{MaxPool, max_pool};
use voxcast_kernels::normalise::normalise;
use voxcast_kernels::panels::packed_len;
use voxcast_kernels::pool::{Mean, mean};
use voxcast_kernels::product::{Product, Residual, SCRATCH};
use voxcast_kernels::project::{Projection, Sum, project_points};
use voxcast_kernels::scale_shift::{ScaleShift, scale_shift};
use voxcast_kernels::upsample_add::{UpsampleAdd, upsample_add};
use voxcast_kernels::window_attention::{Shape, WindowAttention, window_attention};
use voxcast_kernels::{Isa, Panels};

/// Which end of a slice is watched.
#[derive(Clone, Copy, Debug)]
enum Side {
    Front,
    Back,
}

/// Plain values without padding, which can be copied byte by byte.
trait Number: Copy {}
impl Number for bool {}
impl Number for u8 {}
impl Number for u32 {}
impl Number for f16 {}
impl Number for f32 {}

/// A slice between two pages that cannot be touched, against one of them.
struct Guarded<T: Number> {
    map: NonNull<u8>,
    map_len: usize,
    first: NonNull<T>,
    len: usize,
}

impl<T: Number> Guarded<T> {
    fn new(side: Side, numbers: &[T]) -> Self {
        // SAFETY: sysconf takes no pointers.
        let page = usize::try_from(unsafe { libc::sysconf(libc::_SC_PAGESIZE) }).expect("pages have a size");
        let bytes = size_of_val(numbers);
        let inside = bytes.next_multiple_of(page);
        let map_len = inside + 2 * page;
        // SAFETY: a new anonymous mapping overlaps nothing.
        let map = unsafe {
            libc::mmap(std::ptr::null_mut(), map_len, libc::PROT_NONE, libc::MAP_PRIVATE | libc::MAP_ANON, -1, 0)
        };
        assert!(map != libc::MAP_FAILED, "mmap failed");
        let map = NonNull::new(map.cast::<u8>()).expect("a mapping has an address");
        // SAFETY: the pages from the second to the last but one belong to the mapping.
        let allowed =
            unsafe { libc::mprotect(map.as_ptr().add(page).cast(), inside, libc::PROT_READ | libc::PROT_WRITE) };
        assert!(inside == 0 || allowed == 0, "mprotect failed");
        let at = match side {
            Side::Front => page,
            Side::Back => page + inside - bytes,
        };
        // SAFETY: `at` is inside the mapping; it is a multiple of T's size and so of its alignment, because pages and
        // `bytes` are.
        let first = unsafe { map.add(at) }.cast::<T>();
        // SAFETY: from `first` on, `bytes` bytes are writable and belong to nothing else.
        unsafe { std::ptr::copy_nonoverlapping(numbers.as_ptr(), first.as_ptr(), numbers.len()) };
        Self { map, map_len, first, len: numbers.len() }
    }

    fn filled(side: Side, len: usize, number: T) -> Self {
        Self::new(side, &vec![number; len])
    }
}

impl<T: Number> Deref for Guarded<T> {
    type Target = [T];
    fn deref(&self) -> &[T] {
        // SAFETY: `new` wrote `len` numbers from `first` on; they live until `drop`.
        unsafe { std::slice::from_raw_parts(self.first.as_ptr(), self.len) }
    }
}

impl<T: Number> DerefMut for Guarded<T> {
    fn deref_mut(&mut self) -> &mut [T] {
        // SAFETY: as in `deref`, and `self` is borrowed mutably.
        unsafe { std::slice::from_raw_parts_mut(self.first.as_ptr(), self.len) }
    }
}

impl<T: Number> Drop for Guarded<T> {
    fn drop(&mut self) {
        // SAFETY: the mapping is `new`'s, and nothing borrows from it any more.
        unsafe { libc::munmap(self.map.as_ptr().cast(), self.map_len) };
    }
}

/// Unequal numbers of order one.
fn numbers(n: usize) -> Vec<f32> {
    (0..n).map(|i| (i * 37 % 101) as f32 * 0.02 - 1.0).collect()
}

fn halves(n: usize) -> Vec<f16> {
    numbers(n).into_iter().map(f16::from_f32).collect()
}

/// Runs `kernel` on every instruction set and both sides; what it returns must be the same everywhere.
fn everywhere<T: PartialEq + std::fmt::Debug>(kernel: impl Fn(Isa, Side) -> Vec<T>) {
    let want = kernel(Isa::Scalar, Side::Back);
    assert!(!want.is_empty(), "nothing was computed");
    for isa in Isa::available() {
        for side in [Side::Front, Side::Back] {
            assert_eq!(kernel(isa, side), want, "{} {side:?}", isa.name());
        }
    }
}

/// A convolution to 16, 17 and 5 columns, whose rows leave no gap after the last, in both precisions and with every
/// residual.
fn convolve(geometry: Geometry) {
    let depth = geometry.depth();
    for (columns, stride) in [(16, 16), (17, 17), (5, 9)] {
        let span = (geometry.rows() - 1) * stride + columns;
        for (narrow, joins) in [(false, 0), (true, 1), (false, 2), (true, 3)] {
            everywhere(|isa, side| {
                let input = Guarded::new(side, &numbers(geometry.input.iter().product::<usize>() * geometry.channels));
                let single = Guarded::new(side, &numbers(packed_len(depth, columns)));
                let half = Guarded::new(side, &halves(packed_len(depth, columns)));
                let bias = Guarded::new(side, &numbers(columns.next_multiple_of(16)));
                let added = Guarded::new(side, &numbers(span));
                let mut out = Guarded::new(side, &numbers(span));
                let mut scratch = Guarded::filled(side, SCRATCH, 0.0);
                let product = Product {
                    weights: if narrow { Panels::F16(&half) } else { Panels::F32(&single) },
                    bias: &bias,
                    depth,
                    columns,
                    relu: false,
                    residual: match joins {
                        0 => Residual::None,
                        1 => Residual::InPlace,
                        2 => Residual::Before { rows: &added, stride },
                        _ => Residual::After { rows: &added, stride },
                    },
                };
                let args = Conv { geometry, input: &input, product };
                conv(isa, &args, 0..geometry.rows(), stride, &mut out, &mut scratch);
                out.to_vec()
            });
        }
    }
}

/// A geometry with undilated taps.
fn walk(input: [usize; 3], channels: usize, kernel: [usize; 3], stride: usize, padding: [usize; 3]) -> Geometry {
    let output = std::array::from_fn(|i| (input[i] + 2 * padding[i] - kernel[i]) / stride + 1);
    Geometry { input, channels, kernel, stride: [stride; 3], dilation: [1; 3], padding, output }
}

#[test]
fn conv_1x1() {
    convolve(walk([1, 7, 14], 17, [1; 3], 1, [0; 3]));
    convolve(walk([1, 1, 5], 261, [1; 3], 1, [0; 3]));
    convolve(walk([1, 7, 8], 3, [1; 3], 2, [0; 3]));
}

#[test]
fn conv_3x3() {
    convolve(walk([1, 7, 14], 5, [1, 3, 3], 1, [0, 1, 1]));
    convolve(walk([1, 5, 6], 33, [1, 3, 3], 2, [0, 1, 1]));
    convolve(walk([1, 5, 6], 33, [1, 3, 3], 1, [0; 3]));
    convolve(Geometry { dilation: [1, 2, 3], padding: [0, 2, 3], ..walk([1, 6, 7], 9, [1, 3, 3], 1, [0, 1, 1]) });
}

#[test]
fn conv_3d() {
    convolve(walk([4, 3, 5], 10, [3; 3], 1, [1; 3]));
    convolve(walk([4, 5, 6], 16, [2; 3], 1, [0; 3]));
}

#[test]
fn deform() {
    let geometry = walk([1, 5, 7], 19, [1, 3, 3], 1, [0, 1, 1]);
    let (rows, depth, columns) = (geometry.rows(), geometry.depth(), 17);
    // Positions from far outside on; the first and the last output sample where they are, up to both ends of the image.
    let mut offsets: Vec<f32> = (0..rows * 27).map(|i| ((i * 29 % 61) as f32 - 30.0) * 0.25).collect();
    offsets[..18].fill(0.0);
    offsets[(rows - 1) * 27..][..18].fill(0.0);
    everywhere(|isa, side| {
        let input = Guarded::new(side, &numbers(5 * 7 * 19));
        let offsets = Guarded::new(side, &offsets);
        let weights = Guarded::new(side, &numbers(packed_len(depth, columns)));
        let bias = Guarded::new(side, &numbers(32));
        let mut out = Guarded::filled(side, rows * columns, 0.0);
        let mut scratch = Guarded::filled(side, SCRATCH, 0.0);
        let product = Product {
            weights: Panels::F32(&weights),
            bias: &bias,
            depth,
            columns,
            relu: true,
            residual: Residual::None,
        };
        let args = DeformConv2d { geometry, input: &input, offsets: &offsets, product };
        deform_conv2d(isa, &args, 0..rows, columns, &mut out, &mut scratch);
        out.to_vec()
    });
}

#[test]
fn deconv() {
    let (extent, channels) = ([2, 3, 5], 9);
    for columns in [5, 16, 17] {
        let out_len = 8 * 2 * 3 * 5 * columns;
        everywhere(|isa, side| {
            let input = Guarded::new(side, &numbers(2 * 3 * 5 * channels));
            let weights = Guarded::new(side, &halves(8 * packed_len(8 * channels, columns)));
            let bias = Guarded::new(side, &numbers(columns.next_multiple_of(16)));
            let add = Guarded::new(side, &numbers(out_len));
            let mut out = Guarded::filled(side, out_len, 0.0);
            let mut scratch = Guarded::filled(side, SCRATCH, 0.0);
            let args = Deconv3d {
                extent,
                channels,
                columns,
                input: &input,
                weights: Panels::F16(&weights),
                bias: &bias,
                relu: true,
                add: Some(&add),
            };
            deconv3d(isa, &args, 0..4, &mut out, &mut scratch);
            out.to_vec()
        });
    }
}

#[test]
fn gathered_rows() {
    let widths = [(5, 0, 5), (64, 0, 64), (27, 3, 30), (145, 0, 145), (16, 16, 32)];
    for ((channels, first_channel, stride), leave_out) in widths.into_iter().flat_map(|w| [(w, false), (w, true)]) {
        everywhere(|isa, side| {
            let ptr = Guarded::new(side, &[0, 3, 3, 5, 9]);
            let col = Guarded::new(side, &[0, 1, 6, 6, 6, 0, 2, 5, 6]);
            let masked = Guarded::new(side, &[false, true, false, false]);
            let mask = leave_out.then_some(Mask { pixels: 2, masked: &masked });
            let features = Guarded::new(side, &numbers(7 * stride));
            let bias = Guarded::new(side, &numbers(channels));
            let mut out = Guarded::filled(side, 4 * channels, 0.0);
            let args = Gather {
                ptr: &ptr,
                col: &col,
                mask,
                features: &features,
                stride,
                first_channel,
                channels,
                bias: Some(&bias),
                relu: false,
            };
            gather(isa, &args, 0..4, &mut out);
            out.to_vec()
        });
    }
}

#[test]
fn head_of_whole_and_broken_blocks() {
    for (voxels, channels, classes) in [(97, 17, 5), (96, 16, 16), (7, 33, 17)] {
        for (narrow, keep_logits) in [(false, true), (true, false)] {
            everywhere(|isa, side| {
                let input = Guarded::new(side, &numbers(voxels * channels));
                let columns = [channels, channels, classes];
                let single = columns.map(|columns| Guarded::new(side, &numbers(packed_len(channels, columns))));
                let half = columns.map(|columns| Guarded::new(side, &halves(packed_len(channels, columns))));
                let biases = columns.map(|columns| Guarded::new(side, &numbers(columns.next_multiple_of(16))));
                let mut chosen = Guarded::filled(side, voxels, 255u8);
                let mut logits = Guarded::filled(side, voxels * classes, 0.0f32);
                let mut scratch = Guarded::filled(side, scratch_len(channels, classes), 0.0);
                let panels = |i: usize| if narrow { Panels::F16(&half[i]) } else { Panels::F32(&single[i]) };
                let args = Head {
                    input: &input,
                    channels,
                    classes,
                    weights: [0, 1, 2].map(panels),
                    biases: biases.each_ref().map(|b| &b[..]),
                };
                let kept = keep_logits.then_some(&mut logits[..]);
                head(isa, &args, 0..voxels, &mut chosen, kept, &mut scratch);
                chosen.iter().map(|class| f32::from(*class)).chain(logits.iter().copied()).collect()
            });
        }
    }
}

#[test]
fn depthwise_blocks_and_edges() {
    for (width, channels, kernel) in [(17, 19usize, 3), (5, 16, 5), (9, 5, 1)] {
        let padded = channels.next_multiple_of(16);
        everywhere(|isa, side| {
            let input = Guarded::new(side, &numbers(3 * width * channels));
            let weights = Guarded::new(side, &numbers(kernel * kernel * padded));
            let bias = Guarded::new(side, &numbers(padded));
            let mut out = Guarded::filled(side, 3 * width * channels, 0.0);
            let (input, weights, bias) = (&input[..], &weights[..], &bias[..]);
            let args = Depthwise { input, height: 3, width, channels, kernel, weights, bias, residual: true };
            depthwise(isa, &args, 0..3, &mut out);
            out.to_vec()
        });
    }
}

#[test]
fn whole_and_part_vectors_of_channels() {
    for channels in [1usize, 15, 16, 17, 33] {
        let padded = channels.next_multiple_of(16);
        everywhere(|isa, side| {
            let bev = Guarded::new(side, &numbers(3 * channels));
            let mut weights = numbers(channels);
            weights.resize(padded, 0.0);
            let weights = Guarded::new(side, &weights);
            let mut volume = Guarded::new(side, &numbers(3 * 7 * channels));
            gate(isa, &Gate { bev: &bev, depth: 7, channels, weights: &weights, bias: 0.5 }, &mut volume);
            volume.to_vec()
        });
        everywhere(|isa, side| {
            let input = Guarded::new(side, &numbers(5 * 4 * channels));
            let mut out = Guarded::filled(side, 3 * 2 * channels, 0.0);
            let args = MaxPool { input: &input, height: 5, width: 4, channels, kernel: 3, stride: 2, padding: 1 };
            max_pool(isa, &args, 0..3, &mut out);
            out.to_vec()
        });
        everywhere(|isa, side| {
            let input = Guarded::new(side, &numbers(5 * channels));
            let mut out = Guarded::filled(side, channels, 0.0);
            mean(isa, &Mean { input: &input, channels }, &mut out);
            out.to_vec()
        });
        for first_channel in [0, 2] {
            everywhere(|isa, side| {
                let (scale, shift) = (Guarded::new(side, &numbers(padded)), Guarded::new(side, &numbers(padded)));
                let residual = Guarded::new(side, &numbers(3 * (channels + 2)));
                let mut rows = Guarded::new(side, &numbers(3 * (channels + 2)));
                let args = ScaleShift {
                    scale: &scale,
                    shift: &shift,
                    channels,
                    first_channel,
                    stride: channels + 2,
                    residual: Some(&residual),
                    residual_after: true,
                    relu: true,
                };
                scale_shift(isa, &args, &mut rows);
                rows.to_vec()
            });
        }
        everywhere(|isa, side| {
            let low = Guarded::new(side, &numbers(2 * 2 * channels));
            let mut out = Guarded::new(side, &numbers(3 * 4 * channels));
            let args = UpsampleAdd { low: &low, low_height: 2, low_width: 2, height: 3, width: 4, channels };
            upsample_add(isa, &args, 0..3, &mut out);
            out.to_vec()
        });
    }
}

#[test]
fn attention() {
    for (extent, heads, part) in [([7, 7], 2, 8), ([3, 4], 1, 17), ([8, 9], 3, 5)] {
        let shape = Shape { extent, channels: heads * part, heads, key_dim: part };
        let (pad, pad3) = (part.next_multiple_of(16), (3 * part).next_multiple_of(16));
        for row in 0..shape.window_rows() {
            everywhere(|isa, side| {
                let lengths = [
                    extent[0] * extent[1] * shape.channels,
                    heads * packed_len(part, 3 * part),
                    heads * pad3,
                    heads * 25 * pad,
                    heads * pad,
                    heads * shape.side() * shape.side(),
                    packed_len(shape.channels, shape.channels),
                    shape.channels.next_multiple_of(16),
                ];
                let tensors = lengths.map(|n| Guarded::new(side, &numbers(n)));
                let [input, qkv, qkv_bias, query, query_bias, offsets, proj, proj_bias] =
                    tensors.each_ref().map(|t| &t[..]);
                let args = WindowAttention { shape, input, qkv, qkv_bias, query, query_bias, offsets, proj, proj_bias };
                let mut out = Guarded::filled(side, shape.rows(row).len() * extent[1] * shape.channels, 0.0);
                let mut scratch = Guarded::filled(side, shape.scratch_len(), 0.0);
                window_attention(isa, &args, row, &mut out, &mut scratch);
                out.to_vec()
            });
        }
    }
}

#[test]
fn normalised_rows() {
    for (height, width, padded_width, rows) in [(3, 5, 5, 3), (2, 11, 16, 4), (1, 1, 1, 1)] {
        everywhere(|_, side| {
            let image: Vec<u8> = (0..height * width * 3).map(|i| i as u8).collect();
            let image = Guarded::new(side, &image);
            let mut out = Guarded::filled(side, rows * padded_width * 3, 0.0f32);
            normalise(&image, height, width, padded_width, 0, &mut out);
            out.to_vec()
        });
    }
}

/// Rows from the middle: what lies before and after them is not there.
#[test]
fn some_rows_of_many() {
    let geometry = walk([1, 7, 14], 17, [1, 3, 3], 1, [0, 1, 1]);
    let (depth, columns, rows) = (geometry.depth(), 21, 13..52);
    everywhere(|isa, side| {
        let input = Guarded::new(side, &numbers(7 * 14 * 17));
        let weights = Guarded::new(side, &numbers(packed_len(depth, columns)));
        let bias = Guarded::new(side, &numbers(32));
        let mut out = Guarded::filled(side, rows.len() * columns, 0.0);
        let mut scratch = Guarded::filled(side, SCRATCH, 0.0);
        let (weights, residual) = (Panels::F32(&weights), Residual::None);
        let product = Product { weights, bias: &bias, depth, columns, relu: false, residual };
        conv(isa, &Conv { geometry, input: &input, product }, rows.clone(), columns, &mut out, &mut scratch);
        out.to_vec()
    });
}

#[test]
fn projected_points() {
    for z in [1, 7, 8, 9, 24] {
        everywhere(|isa, side| {
            let [xs, ys, zs] = [3, 2, z].map(|n| Guarded::new(side, &numbers(n)));
            let mut out = Guarded::filled(side, 6 * z, 7u32);
            let matrix = [16., 0., 16., 0., 0., 16., 16., 0., 0., 0., 1., 2.];
            let p = Projection { matrix, sum: Sum::Chain, width: 64, height: 32, stride_log2: 3, base: 1 };
            project_points(isa, &p, &xs, &ys, &zs, &mut out);
            out.to_vec()
        });
    }
}

/// The guard itself: the kernel of the machine refuses to copy a byte from there into a pipe.
#[test]
fn the_guard_cannot_be_read() {
    let mut pipe = [0; 2];
    // SAFETY: `pipe` has room for the two descriptors.
    assert_eq!(unsafe { libc::pipe(pipe.as_mut_ptr()) }, 0, "pipe failed");
    // SAFETY: the call checks the address itself, and fails where it cannot be read.
    let readable = |address: *const f32| unsafe { libc::write(pipe[1], address.cast(), 1) } == 1;
    for side in [Side::Front, Side::Back] {
        let numbers = Guarded::filled(side, 5, 1.0f32);
        let first = numbers.first.as_ptr();
        assert!(readable(first) && readable(first.wrapping_add(4)), "{side:?}: the slice cannot be read");
        let beyond = match side {
            Side::Front => first.wrapping_sub(1),
            Side::Back => first.wrapping_add(5),
        };
        assert!(!readable(beyond), "{side:?}: the guard can be read");
    }
    for end in pipe {
        // SAFETY: the descriptors are open, and not used again.
        unsafe { libc::close(end) };
    }
}
