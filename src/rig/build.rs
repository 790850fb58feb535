//! Builds the matrices: project every sample point into every camera, keep each row's distinct pixels in order.
//!
//! ```text
//! for each column (x, y) of a level, in slabs of columns that threads share out:
//!     for each camera that a bounding test does not rule out:
//!         project the n x n x (n * Z) sample points of the column          (kernel)
//!     for each voxel of the column:
//!         set the bit of every pixel that its n^3 points hit               (a set of all cameras' pixels)
//!         append the set bits, ascending, to the volume's row; or them into the column's set; clear them
//!     append the column's set to the BEV row; clear it
//! join the slabs' rows, in order
//! ```
//!
//! A slab's rows depend on nothing but the calibration, and slabs are joined by position: the number of threads cannot
//! show in the result.

use super::axis::axis;
use super::rows::{Growing, PixelSet, out_of_memory, too_many_entries};
use super::view::View;
use super::{Rig, Storage, Tensors};
use crate::error::{Error, ErrorKind, Result};
use crate::network::Network;
use rayon::prelude::*;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Mutex, PoisonError};
use voxcast_kernels::Isa;
use voxcast_kernels::project::project_points;

/// Rows of one matrix. A gibibyte of row pointers; `nuscenes-256` has 2^18.
const MAX_ROWS: u128 = 1 << 28;

/// Sample points times cameras of one level: some ten seconds of work. `nuscenes-200` has 2^25.
const MAX_PROJECTIONS: u128 = 1 << 34;

/// Sample points times cameras of one column: what each thread holds at once. `nuscenes-200` has 2^12.
const MAX_COLUMN: u128 = 1 << 24;

/// Slabs per level: enough to even out columns that few and columns that many cameras see.
const SLABS: usize = 128;

/// Points that the kernel takes at once; lines of sample points are padded to a multiple with points that hit nothing.
const LANES: usize = 8;

/// Builds [`Rig`]s of one network and number of cameras.
///
/// It keeps every buffer between builds, and [`RigBuilder::rebuild`] those of the rig too: once buffers have grown to
/// what the calibrations at hand need, rebuilding allocates no matrix memory.
pub struct RigBuilder {
    levels: [Level; 3],
    slabs: Vec<Slab>,
    /// The cameras of the last build, per level.
    views: [Vec<View>; 3],
    /// One per thread of the pool.
    scratch: Vec<Mutex<Scratch>>,
    cameras: usize,
    isa: Isa,
}

/// What is fixed about a level.
pub(super) struct Level {
    grid: [usize; 3],
    /// Sample points per voxel and axis.
    samples: usize,
    /// Sample coordinates along x, y and z; z padded with NaN to a multiple of [`LANES`].
    axes: [Vec<f32>; 3],
    /// Smallest and largest z coordinate.
    z_range: [f64; 2],
    /// Height and width of the padded image.
    pub(super) image: [usize; 2],
    pub(super) stride_log2: u32,
    /// Feature pixels of one camera.
    pub(super) pixels: usize,
}

/// Some columns of a level and their rows.
struct Slab {
    level: usize,
    columns: std::ops::Range<usize>,
    volume: Rows,
    bev: Rows,
}

/// Consecutive rows of a matrix.
#[derive(Default)]
struct Rows {
    /// Where each row ends in `col`.
    ends: Vec<u32>,
    col: Vec<u32>,
}

/// What a thread needs for a slab.
#[derive(Default)]
struct Scratch {
    /// Flat pixel of each sample point, camera by camera; 0 where it hits none.
    points: Vec<u32>,
    voxel: PixelSet,
    column: PixelSet,
    volume_rows: Growing,
    bev_rows: Growing,
}

impl RigBuilder {
    /// A builder for `cameras` cameras.
    ///
    /// # Errors
    /// [`ErrorKind::Format`] if `network` breaks a rule of [`Network::check`] or `cameras` is 0;
    /// [`ErrorKind::TooLarge`] if flat pixels exceed 32 bits, or a level has more rows or sample points than could be
    /// built in sensible memory and time.
    pub fn new(network: &Network, cameras: usize, isa: Isa) -> Result<Self> {
        network.check()?;
        if cameras == 0 {
            return Err(Error::format("0 cameras, expected at least one"));
        }
        for l in 0..3 {
            check_size(network, l, cameras)?;
        }
        let levels = [0, 1, 2].map(|l| Level::new(network, l));
        let mut slabs = Vec::new();
        for (l, level) in levels.iter().enumerate() {
            let columns = level.grid[0] * level.grid[1];
            let step = columns.div_ceil(SLABS);
            slabs.extend((0..columns).step_by(step).map(|from| Slab {
                level: l,
                columns: from..columns.min(from + step),
                volume: Rows::default(),
                bev: Rows::default(),
            }));
        }
        Ok(Self { levels, slabs, views: Default::default(), scratch: Vec::new(), cameras, isa })
    }

    /// The matrices for `lidar2img`: per camera, row-major 4x4, lidar-frame metres (x, y, z, 1) to (u * d, v * d, d, 1)
    /// with u, v in image pixels. Runs on the current rayon pool; the result does not depend on its threads.
    ///
    /// No matrix is wrong: numbers that are not finite, or a camera that sees nothing of the grid, give no entries.
    ///
    /// # Errors
    /// [`ErrorKind::Mismatch`] if there are not as many matrices as cameras; [`ErrorKind::TooLarge`] if a matrix has
    /// more than 2^32 - 1 entries or memory runs out.
    pub fn build(&mut self, lidar2img: &[[f32; 16]]) -> Result<Rig> {
        self.fill_slabs(lidar2img)?;
        let mut tensors = Tensors::default();
        self.join(&mut tensors)?;
        Ok(Rig { storage: Storage::Owned(tensors), cameras: self.cameras })
    }

    /// [`RigBuilder::build`] into the memory of `rig`, of which nothing else remains. A mapped rig lets go of its file.
    ///
    /// # Errors
    /// As [`RigBuilder::build`]; `rig` is as before then.
    pub fn rebuild(&mut self, lidar2img: &[[f32; 16]], rig: &mut Rig) -> Result<()> {
        match &mut rig.storage {
            Storage::Mapped(..) => *rig = self.build(lidar2img)?,
            Storage::Owned(tensors) => {
                self.fill_slabs(lidar2img)?;
                self.join(tensors)?;
                rig.cameras = self.cameras;
            }
        }
        Ok(())
    }

    /// Joins the slabs' rows. Fails, if it does, before it changes a number.
    fn join(&self, tensors: &mut Tensors<Vec<u32>>) -> Result<()> {
        let slabs: [&[Slab]; 3] = std::array::from_fn(|l| {
            let own = self.slabs.partition_point(|s| s.level < l)..self.slabs.partition_point(|s| s.level <= l);
            &self.slabs[own]
        });
        for (tensors, slabs) in tensors.iter_mut().zip(slabs) {
            for (pair, pick) in tensors.chunks_exact_mut(2).zip(PICKS) {
                let entries = slabs.iter().map(|s| pick(s).col.len()).sum();
                let rows: usize = slabs.iter().map(|s| pick(s).ends.len()).sum();
                for (words, len) in pair.iter_mut().zip([rows + 1, entries]) {
                    words.try_reserve_exact(len.saturating_sub(words.len())).map_err(out_of_memory)?;
                }
            }
        }
        for (tensors, slabs) in tensors.iter_mut().zip(slabs) {
            let [volume_ptr, volume_col, bev_ptr, bev_col] = tensors;
            join_rows(slabs, PICKS[0], volume_ptr, volume_col);
            join_rows(slabs, PICKS[1], bev_ptr, bev_col);
        }
        Ok(())
    }

    /// Computes the rows of all slabs.
    fn fill_slabs(&mut self, lidar2img: &[[f32; 16]]) -> Result<()> {
        if lidar2img.len() != self.cameras {
            let found = lidar2img.len();
            return Err(Error::mismatch(format!("{found} camera matrices, the builder expects {}", self.cameras)));
        }
        while self.scratch.len() < rayon::current_num_threads() {
            self.scratch.push(Mutex::default());
        }
        let points = self.levels.iter().map(|l| self.cameras * l.points()).max().unwrap_or(0);
        let pixels = self.levels.iter().map(|l| self.cameras * l.pixels).max().unwrap_or(0);
        for scratch in &mut self.scratch {
            scratch.get_mut().unwrap_or_else(PoisonError::into_inner).reserve(points, pixels)?;
        }
        for (level, views) in self.levels.iter().zip(&mut self.views) {
            views.clear();
            views.extend(lidar2img.iter().enumerate().map(|(c, m)| View::new(level, self.cameras, c, m)));
        }
        let entries: [[AtomicU64; 2]; 3] = Default::default();
        let (levels, views, scratch, isa) = (&self.levels, &self.views, &self.scratch, self.isa);
        self.slabs.par_iter_mut().with_max_len(1).try_for_each(|slab| {
            // Slabs start no parallel work of their own, so a thread never meets its own lock.
            let thread = rayon::current_thread_index().unwrap_or(0) % scratch.len();
            let mut scratch = scratch[thread].lock().unwrap_or_else(PoisonError::into_inner);
            slab.fill(&levels[slab.level], &views[slab.level], &mut scratch, isa)?;
            for (total, rows) in entries[slab.level].iter().zip([&slab.volume, &slab.bev]) {
                let more = rows.col.len() as u64;
                if total.fetch_add(more, Ordering::Relaxed) + more > u64::from(u32::MAX) {
                    return Err(too_many_entries());
                }
            }
            Ok(())
        })
    }
}

impl std::fmt::Debug for RigBuilder {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("RigBuilder").field("cameras", &self.cameras).field("slabs", &self.slabs.len()).finish()
    }
}

/// Refuses levels that nobody could build. `network` is checked, so 128 bits hold every product.
fn check_size(network: &Network, level: usize, cameras: usize) -> Result<()> {
    let voxels: u128 = network.grids[level].iter().map(|&v| v as u128).product();
    let n = network.samples[level] as u128;
    let projections = (voxels * n * n * n).saturating_mul(cameras as u128);
    let column = (network.grids[level][2].next_multiple_of(LANES) as u128 * n * n * n).saturating_mul(cameras as u128);
    let pixels = (network.feature_pixels(level) as u128).saturating_mul(cameras as u128);
    for (what, found, most) in [
        ("voxels", voxels, MAX_ROWS),
        ("sample points in all cameras", projections, MAX_PROJECTIONS),
        ("sample points of a column in all cameras", column, MAX_COLUMN),
        ("feature pixels of all cameras", pixels, 1 << 32),
    ] {
        if found > most {
            let message = format!("level {}: {found} {what}, at most {most} are supported", level + 1);
            return Err(Error::new(ErrorKind::TooLarge, message));
        }
    }
    Ok(())
}

impl Level {
    pub(super) fn new(network: &Network, level: usize) -> Self {
        let (grid, samples) = (network.grids[level], network.samples[level]);
        let mut axes = [0, 1, 2].map(|a| axis(network.sampling, network.bounds[a], grid[a] * samples));
        let z_range = range(&axes[2]);
        let padded = axes[2].len().next_multiple_of(LANES);
        axes[2].resize(padded, f32::NAN);
        Self {
            grid,
            samples,
            axes,
            z_range,
            image: network.image,
            stride_log2: network.strides[level].ilog2(),
            pixels: network.feature_pixels(level),
        }
    }

    /// Sample points of a column in one camera, padding included.
    fn points(&self) -> usize {
        self.samples * self.samples * self.axes[2].len()
    }
}

/// Smallest and largest of `values`.
fn range(values: &[f32]) -> [f64; 2] {
    values.iter().fold([f64::INFINITY, f64::NEG_INFINITY], |[lo, hi], &v| [lo.min(v.into()), hi.max(v.into())])
}

impl Slab {
    fn fill(&mut self, level: &Level, views: &[View], scratch: &mut Scratch, isa: Isa) -> Result<()> {
        let [_, grid_y, grid_z] = level.grid;
        let n = level.samples;
        let (points, line) = (level.points(), level.axes[2].len());
        let Scratch { points: hits, voxel, column: union, volume_rows, bev_rows } = scratch;
        volume_rows.clear();
        bev_rows.clear();
        for column in self.columns.clone() {
            let xs = &level.axes[0][column / grid_y * n..][..n];
            let ys = &level.axes[1][column % grid_y * n..][..n];
            let bounds = [range(xs), range(ys), level.z_range];
            let mut seen = 0;
            for view in views.iter().filter(|v| v.may_see(&bounds)) {
                let out = &mut hits[seen * points..][..points];
                seen += usize::from(project_points(isa, &view.projection, xs, ys, &level.axes[2], out));
            }
            let hits = &hits[..seen * points];
            volume_rows.reserve(grid_z * (n * n * n).min(level.pixels) * seen)?;
            bev_rows.reserve((grid_z * n * n * n).min(level.pixels) * seen)?;
            for z in 0..grid_z {
                voxel.insert_voxel(hits, line, z * n, n);
                volume_rows.push_row(voxel, |word, bits| union.insert_word(word, bits));
            }
            bev_rows.push_row(union, |_, _| ());
        }
        self.volume.copy(volume_rows)?;
        self.bev.copy(bev_rows)
    }
}

impl Rows {
    /// Becomes the rows of `other`, with no more memory than they need.
    fn copy(&mut self, other: &Growing) -> Result<()> {
        for (to, from) in [(&mut self.ends, &other.ends[..]), (&mut self.col, &other.col[..other.used])] {
            to.clear();
            to.try_reserve_exact(from.len()).map_err(out_of_memory)?;
            to.extend_from_slice(from);
        }
        Ok(())
    }
}

impl Scratch {
    fn reserve(&mut self, points: usize, pixels: usize) -> Result<()> {
        if points > self.points.len() {
            self.points.try_reserve_exact(points - self.points.len()).map_err(out_of_memory)?;
            self.points.resize(points, 0);
        }
        self.voxel.reserve(pixels)?;
        self.column.reserve(pixels)
    }
}

/// The rows of a slab in the volume's and in the BEV's matrix.
const PICKS: [fn(&Slab) -> &Rows; 2] = [|s| &s.volume, |s| &s.bev];

/// Joins the rows that `pick` names of each slab. Both vectors have room.
fn join_rows(slabs: &[Slab], pick: fn(&Slab) -> &Rows, ptr: &mut Vec<u32>, col: &mut Vec<u32>) {
    ptr.resize(slabs.iter().map(|s| pick(s).ends.len()).sum::<usize>() + 1, 0);
    col.resize(slabs.iter().map(|s| pick(s).col.len()).sum(), 0);
    ptr[0] = 0;
    copy_rows(slabs, pick, 0, &mut ptr[1..], col);
}

/// Copies the slabs' rows, the first of which starts at entry `start`, halves in parallel.
fn copy_rows(slabs: &[Slab], pick: fn(&Slab) -> &Rows, start: u32, ptr: &mut [u32], col: &mut [u32]) {
    if let [slab] = slabs {
        let rows = pick(slab);
        for (ptr, end) in ptr.iter_mut().zip(&rows.ends) {
            *ptr = start + end;
        }
        col.copy_from_slice(&rows.col);
        return;
    }
    let (left, right) = slabs.split_at(slabs.len() / 2);
    let (left_ptr, right_ptr) = ptr.split_at_mut(left.iter().map(|s| pick(s).ends.len()).sum());
    let (left_col, right_col) = col.split_at_mut(left.iter().map(|s| pick(s).col.len()).sum());
    let middle = start + left_col.len() as u32;
    rayon::join(
        || copy_rows(left, pick, start, left_ptr, left_col),
        || copy_rows(right, pick, middle, right_ptr, right_col),
    );
}
