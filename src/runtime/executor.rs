//! Operation to kernel call: which slices of the arena, which weights, how the work is cut into tiles. No arithmetic.

use crate::base::error::{Error, ErrorKind, Result};
use crate::base::threads::Threads;
use crate::graph::{Graph, Matrix, Op, Operation, Scope, TensorId};
use crate::rig::{Csr, Level};
use crate::runtime::arena::View;
use crate::runtime::plan::Plan;
use std::ops::Range;
use voxcast_kernels::conv::{Conv, Geometry, conv};
use voxcast_kernels::deconv3d::{Deconv3d, deconv3d};
use voxcast_kernels::deform_conv2d::{DeformConv2d, deform_conv2d};
use voxcast_kernels::depthwise::{Depthwise, depthwise};
use voxcast_kernels::gate::{Gate, gate};
use voxcast_kernels::gather::{Gather, Mask, gather};
use voxcast_kernels::head::{Head, head};
use voxcast_kernels::matmul::{BLOCK_ROWS, Product, Residual};
use voxcast_kernels::max_pool::{MaxPool, max_pool};
use voxcast_kernels::normalise::normalise;
use voxcast_kernels::pool::{Mean, broadcast, mean};
use voxcast_kernels::scale_shift::{ScaleShift, scale_shift};
use voxcast_kernels::upsample_add::{UpsampleAdd, upsample_add};
use voxcast_kernels::window_attention::{WindowAttention, window_attention};
use voxcast_kernels::{Isa, Panels};

/// Numbers in the image rows or volume planes that one worker computes at a time, at least.
const LINES: usize = 1 << 14;
/// Voxels or cells that one worker gathers at a time.
const GATHER_ROWS: usize = 500;
/// Voxels that one worker classifies at a time.
const HEAD_ROWS: usize = 960;

/// Computes rows, `stride` apart, with scratch.
type RowsKernel<'a> = dyn Fn(Range<usize>, usize, &mut [f32], &mut [f32]) + Sync + 'a;
/// Computes dense lines, with scratch.
type LinesKernel<'a> = dyn Fn(Range<usize>, &mut [f32], &mut [f32]) + Sync + 'a;
/// Computes the piece of an index, with scratch.
type PieceKernel<'a> = dyn Fn(usize, &mut [f32], &mut [f32]) + Sync + 'a;

/// Where a head's result goes.
pub(crate) struct HeadOutput<'a> {
    pub(crate) classes: &'a mut [u8],
    pub(crate) logits: Option<&'a mut [f32]>,
}

/// Everything but memory that operations need.
pub(crate) struct Executor {
    pub(crate) isa: Isa,
    pub(crate) graph: Graph,
    pub(crate) plan: Plan,
    pub(crate) cameras: usize,
    pub(crate) threads: Threads,
}

/// What changes from call to call of the same operation.
pub(crate) struct Call<'a> {
    pub(crate) camera: usize,
    /// The image of the camera whose pass this is.
    pub(crate) image: Option<Image<'a>>,
    pub(crate) levels: &'a [Level<'a>; 3],
    /// Cameras to leave out, if there are any.
    pub(crate) masked: Option<&'a [bool]>,
    pub(crate) head: Option<HeadOutput<'a>>,
    pub(crate) slice: Slice,
}

/// A dense image, blue first.
#[derive(Clone, Copy)]
pub(crate) struct Image<'a> {
    pub(crate) height: usize,
    pub(crate) width: usize,
    pub(crate) bgr: &'a [u8],
}

/// The part of an operation that a call runs: from tile `first`, one of about `parts` equal shares of the tiles.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Slice {
    pub(crate) first: usize,
    pub(crate) parts: usize,
}

/// The next tile of an operation, unless all have run.
pub(crate) type Next = Option<usize>;

impl Executor {
    /// Numbers of tensor `id` within the arena; those of camera `camera` where each has its own.
    fn range(&self, id: TensorId, camera: usize) -> Range<usize> {
        let tensor = self.graph.tensor(id);
        let start = self.plan.place(id).start + if tensor.scope == Scope::Features { camera * tensor.len() } else { 0 };
        start..start + tensor.len()
    }

    /// Numbers of tensor `id`, those of all cameras.
    fn whole_range(&self, id: TensorId) -> Range<usize> {
        let tensor = self.graph.tensor(id);
        let copies = if tensor.scope == Scope::Features { self.cameras } else { 1 };
        let start = self.plan.place(id).start;
        start..start + tensor.len() * copies
    }

    /// The numbers that `operation` wrote last, for whoever looks on.
    pub(crate) fn output<'v>(&self, view: View<'v>, operation: &Operation, camera: usize) -> &'v [f32] {
        // SAFETY: called between operations, when nothing is written.
        unsafe { view.read(self.range(operation.output, camera)) }
    }

    /// Checks, once per session, what [`Executor::run`] relies on: an operation writes only its output and its workers'
    /// scratch, and neither meets anything that it reads, but for what it overwrites in place.
    pub(crate) fn check(&self) -> Result<()> {
        let broken = |name: &str| Error::new(ErrorKind::Unsupported, format!("the plan breaks operation \"{name}\""));
        let apart = |a: &Range<usize>, b: &Range<usize>| a.end <= b.start || b.end <= a.start;
        for operation in &self.graph.operations {
            let output = match operation.op {
                Op::Head { .. } => 0..0,
                _ => self.whole_range(operation.output),
            };
            let scratch: Vec<Range<usize>> = (0..self.plan.workers()).map(|w| self.plan.scratch(w)).collect();
            for (i, one) in scratch.iter().enumerate() {
                let others = scratch[i + 1..].iter().chain(std::iter::once(&output));
                if !others.into_iter().all(|other| apart(one, other)) {
                    return Err(broken(&operation.name));
                }
            }
            for id in operation.reads() {
                let read = self.whole_range(id);
                let replaced = operation.in_place() == Some(id) || self.starts_in_place(operation, id);
                let same = read == output;
                if !scratch.iter().all(|s| apart(s, &read)) || !(apart(&read, &output) || (replaced && same)) {
                    return Err(broken(&operation.name));
                }
            }
            if operation.in_place().is_some_and(|id| self.whole_range(id) != output) {
                return Err(broken(&operation.name));
            }
        }
        Ok(())
    }

    /// Whether the residual `id` of a convolution lies where its output goes.
    fn starts_in_place(&self, operation: &Operation, id: TensorId) -> bool {
        let convolution = matches!(operation.op, Op::Conv { .. } | Op::DeformConv { .. });
        convolution
            && operation.residual.is_some_and(|r| r.tensor == id && !r.after)
            && self.plan.place(id) == self.plan.place(operation.output)
    }

    /// Runs a slice of `operation` on the current pool. `weights` are its parts.
    ///
    /// Tiles are the same whatever the slices, and each runs once: slices cannot show in a result.
    pub(crate) fn run(&self, view: View<'_>, operation: &Operation, weights: &[Panels<'_>], call: Call<'_>) -> Next {
        // SAFETY: `check` found the inputs apart from everything that this operation writes.
        let input = |i: usize| unsafe { view.read(self.range(operation.inputs[i], call.camera)) };
        match &operation.op {
            Op::Normalise => self.normalise(view, operation, &call),
            Op::Conv { geometry } => {
                let product = self.product(view, operation, weights, geometry.depth(), call.camera);
                let args = Conv { geometry: *geometry, input: input(0), product };
                self.rows(view, operation, geometry, &call, &|rows, stride, out, scratch| {
                    conv(self.isa, &args, rows, stride, out, scratch);
                })
            }
            Op::DeformConv { geometry } => {
                let product = self.product(view, operation, weights, geometry.depth(), call.camera);
                let args = DeformConv2d { geometry: *geometry, input: input(0), offsets: input(1), product };
                self.rows(view, operation, geometry, &call, &|rows, stride, out, scratch| {
                    deform_conv2d(self.isa, &args, rows, stride, out, scratch);
                })
            }
            Op::Depthwise { side } => {
                let [_, height, width] = self.graph.tensor(operation.output).extent;
                let args = Depthwise {
                    input: input(0),
                    height,
                    width,
                    channels: operation.channels,
                    kernel: *side,
                    weights: plain(weights, 0),
                    bias: plain(weights, 1),
                    residual: operation.residual.is_some(),
                };
                self.lines(view, operation, &call, height, &|rows, out, _| depthwise(self.isa, &args, rows, out))
            }
            Op::BatchNorm => self.batch_norm(view, operation, weights, &call),
            Op::MaxPool { side, stride, padding } => {
                let [_, height, width] = self.graph.tensor(operation.inputs[0]).extent;
                let args = MaxPool {
                    input: input(0),
                    height,
                    width,
                    channels: operation.channels,
                    kernel: *side,
                    stride: *stride,
                    padding: *padding,
                };
                let lines = args.output()[0];
                self.lines(view, operation, &call, lines, &|rows, out, _| max_pool(self.isa, &args, rows, out))
            }
            Op::UpsampleAdd => {
                let [_, height, width] = self.graph.tensor(operation.output).extent;
                let [_, low_height, low_width] = self.graph.tensor(operation.inputs[1]).extent;
                let args =
                    UpsampleAdd { low: input(1), low_height, low_width, height, width, channels: operation.channels };
                self.lines(view, operation, &call, height, &|rows, out, _| {
                    upsample_add(self.isa, &args, rows, out);
                })
            }
            Op::Gather { level, matrix, first_channel, .. } => {
                let Csr { ptr, col } = csr(call.levels, *level, *matrix);
                // SAFETY: as for `input`.
                let features = unsafe { view.read(self.whole_range(operation.inputs[0])) };
                let pixels = self.graph.tensor(operation.inputs[0]).rows();
                let args = Gather {
                    ptr,
                    col,
                    mask: call.masked.map(|masked| Mask { pixels, masked }),
                    features,
                    stride: self.graph.tensor(operation.inputs[0]).channels,
                    first_channel: *first_channel,
                    channels: operation.channels,
                    bias: weights.first().map(|_| plain(weights, 0)),
                    relu: operation.relu,
                };
                self.chunks(view, operation, &call, GATHER_ROWS, &|rows, out, _| {
                    gather(self.isa, &args, rows, out);
                })
            }
            Op::Deconv => {
                let x = self.graph.tensor(operation.inputs[0]);
                let add = operation.residual.map(|r| {
                    // SAFETY: as for `input`.
                    unsafe { view.read(self.range(r.tensor, call.camera)) }
                });
                let args = Deconv3d {
                    extent: x.extent,
                    channels: x.channels,
                    columns: operation.channels,
                    input: input(0),
                    weights: weights[0],
                    bias: plain(weights, 1),
                    relu: operation.relu,
                    add,
                };
                let planes = 2 * x.extent[0];
                self.lines(view, operation, &call, planes, &|planes, out, scratch| {
                    deconv3d(self.isa, &args, planes, out, scratch);
                })
            }
            Op::WindowAttention { shape } => {
                let args = WindowAttention {
                    shape: *shape,
                    input: input(0),
                    qkv: plain(weights, 0),
                    qkv_bias: plain(weights, 1),
                    query: plain(weights, 2),
                    query_bias: plain(weights, 3),
                    offsets: plain(weights, 4),
                    proj: plain(weights, 5),
                    proj_bias: plain(weights, 6),
                };
                let step = shape.window()[0] * shape.extent[1] * shape.channels;
                self.pieces(view, operation, &call, step, &|row, out, scratch| {
                    window_attention(self.isa, &args, row, out, scratch);
                })
            }
            Op::Gate => {
                let depth = self.graph.tensor(operation.output).extent[2];
                let bev = input(1);
                let step = GATHER_ROWS.div_ceil(depth) * operation.channels;
                self.pieces(view, operation, &call, step * depth, &|index, out, _| {
                    let args = Gate {
                        bev: &bev[index * step..index * step + out.len() / depth],
                        depth,
                        channels: operation.channels,
                        weights: plain(weights, 0),
                        bias: plain(weights, 1)[0],
                    };
                    gate(self.isa, &args, out);
                })
            }
            Op::GlobalMean => {
                let args = Mean { input: input(0), channels: operation.channels };
                self.pieces(view, operation, &call, operation.channels, &|_, out, _| mean(self.isa, &args, out))
            }
            Op::Broadcast => {
                let stride = self.graph.tensor(operation.output).channels;
                self.pieces(view, operation, &call, GATHER_ROWS * stride, &|_, out, _| {
                    broadcast(input(0), stride, operation.first_channel, out);
                })
            }
            Op::Head { .. } => self.head(view, operation, weights, input(0), call),
        }
    }

    fn normalise(&self, view: View<'_>, operation: &Operation, call: &Call<'_>) -> Next {
        let [_, height, width] = self.graph.tensor(operation.output).extent;
        let Image { height: image_height, width: image_width, bgr } =
            call.image.expect("the pass of a camera has its image");
        self.lines(view, operation, call, height, &|rows, out, _| {
            normalise(bgr, image_height, image_width, width, rows.start, out);
        })
    }

    fn batch_norm(&self, view: View<'_>, operation: &Operation, weights: &[Panels<'_>], call: &Call<'_>) -> Next {
        let tensor = self.graph.tensor(operation.output);
        let residual = operation.residual.map(|r| {
            // SAFETY: `check` found the residual apart from the output.
            (unsafe { view.read(self.range(r.tensor, call.camera)) }, r.after)
        });
        let step = GATHER_ROWS * tensor.channels;
        self.pieces(view, operation, call, step, &|index, out, _| {
            let args = ScaleShift {
                scale: plain(weights, 0),
                shift: plain(weights, 1),
                channels: operation.channels,
                first_channel: operation.first_channel,
                stride: tensor.channels,
                residual: residual.map(|(rows, _)| &rows[index * step..index * step + out.len()]),
                residual_after: residual.is_some_and(|(_, after)| after),
                relu: operation.relu,
            };
            scale_shift(self.isa, &args, out);
        })
    }

    fn head(
        &self,
        view: View<'_>,
        operation: &Operation,
        weights: &[Panels<'_>],
        input: &[f32],
        call: Call<'_>,
    ) -> Next {
        let HeadOutput { classes, logits } = call.head.expect("a head is given room for its result");
        let args = Head {
            input,
            channels: self.graph.tensor(operation.inputs[0]).channels,
            classes: operation.channels,
            weights: [weights[0], weights[2], weights[4]],
            biases: [plain(weights, 1), plain(weights, 3), plain(weights, 5)],
        };
        let rows = classes.len();
        let classes = Shared::new(classes);
        let logits = logits.map(Shared::new);
        self.tiles(call.slice, rows.div_ceil(HEAD_ROWS), &|worker, tile| {
            let rows = tile * HEAD_ROWS..rows.min((tile + 1) * HEAD_ROWS);
            // SAFETY: each tile has its own rows, and each worker its own scratch.
            let (classes, logits, scratch) = unsafe {
                let logits = logits.as_ref().map(|l| l.part(rows.start * args.classes..rows.end * args.classes));
                (classes.part(rows.clone()), logits, view.write(self.plan.scratch(worker)))
            };
            head(self.isa, &args, rows, classes, logits, scratch);
        })
    }

    /// The right matrix of a convolution, with the residual as the kernel takes it.
    fn product<'a>(
        &self,
        view: View<'a>,
        operation: &Operation,
        weights: &[Panels<'a>],
        depth: usize,
        camera: usize,
    ) -> Product<'a> {
        let residual = match operation.residual {
            None => Residual::None,
            Some(r) if self.starts_in_place(operation, r.tensor) => Residual::InPlace,
            Some(r) => {
                let stride = self.graph.tensor(r.tensor).channels;
                // SAFETY: `check` found the residual apart from the output.
                let rows = unsafe { view.read(self.range(r.tensor, camera)) };
                if r.after { Residual::After { rows, stride } } else { Residual::Before { rows, stride } }
            }
        };
        Product {
            weights: weights[0],
            bias: plain(weights, 1),
            depth,
            columns: operation.channels,
            relu: operation.relu,
            residual,
        }
    }

    /// Cuts a convolution's rows into tiles. The output may be some channels of a wider tensor.
    fn rows(
        &self,
        view: View<'_>,
        operation: &Operation,
        geometry: &Geometry,
        call: &Call<'_>,
        kernel: &RowsKernel<'_>,
    ) -> Next {
        let stride = self.graph.tensor(operation.output).channels;
        let start = self.range(operation.output, call.camera).start + operation.first_channel;
        let rows = geometry.rows();
        // As many tiles as blocks of rows, but the same number for every worker.
        let tiles = rows.div_ceil(BLOCK_ROWS).next_multiple_of(self.plan.workers());
        let per_tile = rows.div_ceil(tiles).next_multiple_of(self.isa.tile().rows);
        self.tiles(call.slice, rows.div_ceil(per_tile), &|worker, tile| {
            let rows = tile * per_tile..rows.min((tile + 1) * per_tile);
            let place = start + rows.start * stride..start + (rows.end - 1) * stride + operation.channels;
            // SAFETY: each tile has its own rows, and each worker its own scratch; `check` found both apart from
            // everything that is read.
            let (out, scratch) = unsafe { (view.write(place), view.write(self.plan.scratch(worker))) };
            kernel(rows, stride, out, scratch);
        })
    }

    /// Gives each worker a few of `lines` equal lines of the output: image rows or volume planes.
    fn lines(
        &self,
        view: View<'_>,
        operation: &Operation,
        call: &Call<'_>,
        lines: usize,
        kernel: &LinesKernel<'_>,
    ) -> Next {
        let line = self.range(operation.output, call.camera).len() / lines;
        // Small tiles, so that a slice can be short; but enough work in each to be worth handing out.
        let per_tile = LINES.div_ceil(line.max(1)).min(lines.div_ceil(8 * self.plan.workers())).max(1);
        self.pieces(view, operation, call, per_tile * line, &|tile, out, scratch| {
            let first = tile * per_tile;
            kernel(first..first + out.len() / line, out, scratch);
        })
    }

    /// Gives each worker up to `rows` positions of the output at a time.
    fn chunks(
        &self,
        view: View<'_>,
        operation: &Operation,
        call: &Call<'_>,
        rows: usize,
        kernel: &LinesKernel<'_>,
    ) -> Next {
        self.pieces(view, operation, call, rows * operation.channels, &|tile, out, scratch| {
            let first = tile * rows;
            kernel(first..first + out.len() / operation.channels, out, scratch);
        })
    }

    /// Cuts the output into pieces of `len` numbers.
    fn pieces(
        &self,
        view: View<'_>,
        operation: &Operation,
        call: &Call<'_>,
        len: usize,
        kernel: &PieceKernel<'_>,
    ) -> Next {
        let Range { start, end } = self.range(operation.output, call.camera);
        self.tiles(call.slice, (end - start).div_ceil(len), &|worker, tile| {
            let place = start + tile * len..end.min(start + (tile + 1) * len);
            // SAFETY: each tile has its own piece, and each worker its own scratch; `check` found both apart from
            // everything that is read.
            let (out, scratch) = unsafe { (view.write(place), view.write(self.plan.scratch(worker))) };
            kernel(tile, out, scratch);
        })
    }

    /// Runs the slice's share of `count` tiles.
    fn tiles(&self, slice: Slice, count: usize, tile: &(dyn Fn(usize, usize) + Sync)) -> Next {
        let workers = self.plan.workers();
        let share = count.div_ceil(slice.parts).next_multiple_of(workers);
        let end = count.min(slice.first.saturating_add(share));
        self.threads.for_each_tile(workers, end - slice.first, &|worker, index| tile(worker, slice.first + index));
        (end < count).then_some(end)
    }
}

/// The matrix of a gather.
pub(crate) fn csr<'a>(levels: &[Level<'a>; 3], level: usize, matrix: Matrix) -> Csr<'a> {
    let Level { volume, bev } = levels[level];
    if matrix == Matrix::Volume { volume } else { bev }
}

/// A part that is stored in f32 whatever the model's precision.
fn plain<'a>(weights: &[Panels<'a>], part: usize) -> &'a [f32] {
    match weights[part] {
        Panels::F32(numbers) => numbers,
        Panels::F16(_) => unreachable!("only packed panels are stored in half precision"),
    }
}

/// A slice whose disjoint parts several threads write.
struct Shared<'a, T> {
    base: *mut T,
    len: usize,
    slice: std::marker::PhantomData<&'a mut [T]>,
}

// SAFETY: a pointer into a slice that `'a` keeps exclusively borrowed; `part` says what threads may do with it.
unsafe impl<T: Send> Sync for Shared<'_, T> {}

impl<'a, T> Shared<'a, T> {
    fn new(slice: &'a mut [T]) -> Self {
        Self { base: slice.as_mut_ptr(), len: slice.len(), slice: std::marker::PhantomData }
    }

    /// # Safety
    /// Parts that live at the same time must not overlap.
    unsafe fn part(&self, range: Range<usize>) -> &'a mut [T] {
        assert!(range.start <= range.end && range.end <= self.len, "part outside the slice");
        // SAFETY: in bounds as just checked; exclusive as the caller promises.
        unsafe { std::slice::from_raw_parts_mut(self.base.add(range.start), range.len()) }
    }
}
