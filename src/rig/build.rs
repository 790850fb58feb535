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

use super::calibration::Calibration;
use super::frustum::Frustum;
use super::level::{LevelGrid, range};
use super::rows::{Growing, PixelSet, out_of_memory, too_many_entries};
use super::{Rig, Storage, Tensors};
use crate::base::error::{Error, ErrorKind, Result};
use crate::base::threads::Threads;
use crate::network::Network;
use std::ops::Range;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Mutex, MutexGuard, PoisonError};
use voxcast_kernels::project::project_points;
use voxcast_kernels::{Isa, LANES};

/// Rows of one matrix. A gibibyte of row pointers; `nuscenes-256` has 2^18.
const MAX_ROWS: u128 = 1 << 28;

/// Sample points times cameras of one level: some ten seconds of work. `nuscenes-200` has 2^25.
const MAX_PROJECTIONS: u128 = 1 << 34;

/// Sample points times cameras of one column: what each thread holds at once. `nuscenes-200` has 2^12.
const MAX_COLUMN: u128 = 1 << 24;

/// Slabs per level: enough to even out columns that few and columns that many cameras see.
const SLABS: usize = 128;

/// Builds [`Rig`]s of one network and number of cameras, on the calling thread or those of [`RigBuilder::with_threads`].
///
/// It keeps every buffer between builds, and [`RigBuilder::rebuild`] trades them with the rig: once all have grown to what
/// the calibrations at hand need, rebuilding allocates nothing.
///
/// A controller that has little time at a time calls [`RigBuilder::begin`] and [`RigBuilder::advance`], and swaps two rigs:
///
/// ```
/// use std::sync::Arc;
/// use voxcast::rig::RigBuilder;
/// use voxcast::{Isa, Network, Rig, Session};
///
/// /// Some of the work on `spare`, which no session uses. Whether the session has it now, and `spare` is the other.
/// fn tick(builder: &mut RigBuilder, spare: &mut Arc<Rig>, session: &mut Session) -> voxcast::Result<bool> {
///     let rig = Arc::get_mut(spare).expect("nobody else holds the spare rig");
///     let complete = builder.advance(8, rig)?;
///     if complete {
///         *spare = session.set_rig(spare.clone())?;
///     }
///     Ok(complete)
/// }
/// # let network = Network::built_in("nuscenes-200").expect("built in");
/// # RigBuilder::new(&network, 6, Isa::best())?;
/// # Ok::<(), voxcast::Error>(())
/// ```
pub struct RigBuilder {
    levels: [LevelGrid; 3],
    slabs: Vec<Mutex<Slab>>,
    /// The cameras of the last build, per level.
    views: [Vec<Frustum>; 3],
    /// One per thread.
    scratch: Vec<Mutex<Scratch>>,
    threads: Threads,
    cameras: usize,
    /// [`Calibration`] of the rig that is under way.
    calibration: Calibration,
    isa: Isa,
    /// Entries of each matrix so far.
    entries: [[AtomicU64; 2]; 3],
    /// Where rows are joined before a rig has them.
    tensors: Tensors<Vec<u32>>,
    /// Slabs computed, then slabs joined; nothing where no build is under way.
    done: Option<usize>,
}

/// Some columns of a level and their rows.
struct Slab {
    level: usize,
    columns: std::ops::Range<usize>,
    volume: MatrixRows,
    bev: MatrixRows,
}

/// Consecutive rows of a matrix.
#[derive(Default)]
struct MatrixRows {
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
        let levels = [0, 1, 2].map(|l| LevelGrid::new(network, l));
        let mut slabs = Vec::new();
        for (l, level) in levels.iter().enumerate() {
            let columns = level.grid[0] * level.grid[1];
            let step = columns.div_ceil(SLABS);
            slabs.extend((0..columns).step_by(step).map(|from| {
                let columns = from..columns.min(from + step);
                Mutex::new(Slab { level: l, columns, volume: MatrixRows::default(), bev: MatrixRows::default() })
            }));
        }
        Ok(Self {
            levels,
            slabs,
            views: Default::default(),
            scratch: vec![Mutex::default()],
            threads: Threads::calling(),
            cameras,
            calibration: Calibration::default(),
            isa,
            entries: Default::default(),
            tensors: Tensors::default(),
            done: None,
        })
    }

    /// The builder with threads to compute on. Their number cannot change a rig.
    #[must_use]
    pub fn with_threads(mut self, threads: Threads) -> Self {
        self.scratch.resize_with(threads.count(), Mutex::default);
        self.threads = threads;
        self
    }

    /// The matrices for `lidar2img`: per camera, row-major 4x4, lidar-frame metres (x, y, z, 1) to (u * d, v * d, d, 1)
    /// with u, v in image pixels.
    ///
    /// No matrix is wrong: numbers that are not finite, or a camera that sees nothing of the grid, give no entries.
    ///
    /// # Errors
    /// [`ErrorKind::Mismatch`] if there are not as many matrices as cameras; [`ErrorKind::TooLarge`] if a matrix has
    /// more than 2^32 - 1 entries or memory runs out.
    pub fn build(&mut self, lidar2img: &[[f32; 16]]) -> Result<Rig> {
        let mut rig = Rig {
            storage: Storage::Owned(Tensors::default()),
            cameras: self.cameras,
            calibration: Calibration::default(),
        };
        self.rebuild(lidar2img, &mut rig)?;
        Ok(rig)
    }

    /// [`RigBuilder::build`] into `rig`, whose memory serves the next build. A mapped rig lets go of its file.
    ///
    /// # Errors
    /// As [`RigBuilder::build`]; `rig` is as before then.
    pub fn rebuild(&mut self, lidar2img: &[[f32; 16]], rig: &mut Rig) -> Result<()> {
        self.begin(lidar2img)?;
        self.advance(usize::MAX, rig).map(|complete| debug_assert!(complete))
    }

    /// Begins a rig for `lidar2img`, which [`RigBuilder::advance`] builds. One that was under way is dropped.
    ///
    /// # Errors
    /// As [`RigBuilder::build`].
    pub fn begin(&mut self, lidar2img: &[[f32; 16]]) -> Result<()> {
        self.done = None;
        if lidar2img.len() != self.cameras {
            let found = lidar2img.len();
            return Err(Error::mismatch(format!("{found} camera matrices, the builder expects {}", self.cameras)));
        }
        let points = self.levels.iter().map(|l| self.cameras * l.points()).max().unwrap_or(0);
        let pixels = self.levels.iter().map(|l| self.cameras * l.pixels).max().unwrap_or(0);
        // Which thread gets the largest slab is chance: what one has needed, all have, so that none grows in a later build.
        let most = |a: [usize; 2], b: [usize; 2]| [a[0].max(b[0]), a[1].max(b[1])];
        let mut room = [[0; 2]; 2];
        for scratch in &mut self.scratch {
            let rows = scratch.get_mut().unwrap_or_else(PoisonError::into_inner).rows();
            room = [most(room[0], rows[0].room()), most(room[1], rows[1].room())];
        }
        for scratch in &mut self.scratch {
            let scratch = scratch.get_mut().unwrap_or_else(PoisonError::into_inner);
            scratch.reserve(points, pixels)?;
            scratch.rows().into_iter().zip(room).try_for_each(|(rows, room)| rows.grow_to(room))?;
        }
        for (level, views) in self.levels.iter().zip(&mut self.views) {
            views.clear();
            views.extend(lidar2img.iter().enumerate().map(|(c, m)| Frustum::new(level, self.cameras, c, m)));
        }
        self.calibration.set(lidar2img);
        self.entries = Default::default();
        self.done = Some(0);
        Ok(())
    }

    /// Steps that a whole build takes: [`RigBuilder::advance`] counts in them.
    pub fn steps(&self) -> usize {
        2 * self.slabs.len()
    }

    /// Does `steps` of the [`RigBuilder::steps`] of the rig that was begun, each at most a hundredth or so of a level.
    /// True if it is complete; `rig` is the new one then, and unchanged before.
    ///
    /// # Errors
    /// [`ErrorKind::TooLarge`] as [`RigBuilder::build`]; [`ErrorKind::Mismatch`] if nothing was begun. `rig` is as before.
    pub fn advance(&mut self, steps: usize, rig: &mut Rig) -> Result<bool> {
        // An error leaves nothing under way.
        let Some(from) = self.done.take() else {
            return Err(Error::mismatch("no rig was begun, expected a call of `begin` first"));
        };
        let slabs = self.slabs.len();
        let to = from.saturating_add(steps.max(1)).min(2 * slabs);
        if from < slabs {
            self.fill(from..to.min(slabs))?;
        }
        if to > slabs {
            if from <= slabs {
                self.reserve()?;
            }
            for slab in from.max(slabs)..to {
                self.join(slab - slabs);
            }
        }
        if to < 2 * slabs {
            self.done = Some(to);
            return Ok(false);
        }
        match &mut rig.storage {
            Storage::Owned(tensors) => std::mem::swap(tensors, &mut self.tensors),
            mapped => *mapped = Storage::Owned(std::mem::take(&mut self.tensors)),
        }
        rig.cameras = self.cameras;
        std::mem::swap(&mut rig.calibration, &mut self.calibration);
        Ok(true)
    }

    /// Computes the rows of some slabs.
    fn fill(&self, slabs: Range<usize>) -> Result<()> {
        let failed = Mutex::new(None);
        let fill = |worker: usize, index: usize| {
            // Every slab and every worker's scratch is one tile's at a time, so no lock is waited for.
            let (mut slab, mut scratch) = (lock(&self.slabs[slabs.start + index]), lock(&self.scratch[worker]));
            let level = slab.level;
            let filled = slab.fill(&self.levels[level], &self.views[level], &mut scratch, self.isa);
            let counted = filled.and_then(|()| {
                self.entries[level].iter().zip([&slab.volume, &slab.bev]).try_for_each(|(total, rows)| {
                    let more = rows.col.len() as u64;
                    let sum = total.fetch_add(more, Ordering::Relaxed) + more;
                    if sum > u64::from(u32::MAX) { Err(too_many_entries()) } else { Ok(()) }
                })
            });
            if let Err(error) = counted {
                lock(&failed).get_or_insert(error);
            }
        };
        self.threads.enter(|| self.threads.for_each_tile(self.scratch.len(), slabs.len(), &fill));
        failed.into_inner().unwrap_or_else(PoisonError::into_inner).map_or(Ok(()), Err)
    }

    /// Makes room for all rows.
    fn reserve(&mut self) -> Result<()> {
        for (level, (tensors, entries)) in self.levels.iter().zip(self.tensors.iter_mut().zip(&mut self.entries)) {
            let columns = level.grid[0] * level.grid[1];
            let rows = [columns * level.grid[2], columns];
            for ((pair, entries), rows) in tensors.as_chunks_mut::<2>().0.iter_mut().zip(entries).zip(rows) {
                for (words, len) in pair.iter_mut().zip([rows + 1, *entries.get_mut() as usize]) {
                    words.clear();
                    words.try_reserve_exact(len).map_err(out_of_memory)?;
                }
                pair[0].push(0);
            }
        }
        Ok(())
    }

    /// Appends the rows of a slab. There is room.
    fn join(&mut self, slab: usize) {
        let slab = self.slabs[slab].get_mut().unwrap_or_else(PoisonError::into_inner);
        let [volume_ptr, volume_col, bev_ptr, bev_col] = &mut self.tensors[slab.level];
        for (ptr, col, rows) in [(volume_ptr, volume_col, &slab.volume), (bev_ptr, bev_col, &slab.bev)] {
            let start = col.len() as u32;
            ptr.extend(rows.ends.iter().map(|end| start + end));
            col.extend_from_slice(&rows.col);
        }
    }
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
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
        ("feature pixels of all cameras", pixels, (1 << 32).min(usize::MAX as u128)),
    ] {
        if found > most {
            let message = format!("level {}: {found} {what}, at most {most} are supported", level + 1);
            return Err(Error::new(ErrorKind::TooLarge, message));
        }
    }
    Ok(())
}

impl Slab {
    fn fill(&mut self, level: &LevelGrid, views: &[Frustum], scratch: &mut Scratch, isa: Isa) -> Result<()> {
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

impl MatrixRows {
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
    fn rows(&mut self) -> [&mut Growing; 2] {
        [&mut self.volume_rows, &mut self.bev_rows]
    }

    fn reserve(&mut self, points: usize, pixels: usize) -> Result<()> {
        if points > self.points.len() {
            self.points.try_reserve_exact(points - self.points.len()).map_err(out_of_memory)?;
            self.points.resize(points, 0);
        }
        self.voxel.reserve(pixels)?;
        self.column.reserve(pixels)
    }
}
