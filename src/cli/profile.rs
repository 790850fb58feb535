//! `voxcast profile`

use super::terminal::tell;
use super::{Machine, frame, terminal};
use clap::Args;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};
use voxcast::graph::{Element, Graph, Operation};
use voxcast::session::{Event, views};
use voxcast::{Budget, Error, ImageView, Isa, Result, Session, Step, Threads};
use voxcast_kernels::conv::Geometry;
use voxcast_kernels::conv_i8::{ConvI8, conv_i8};
use voxcast_kernels::panels::packed_len;
use voxcast_kernels::product::int8::{layout, scratch_len};
use voxcast_kernels::product::{ProductI8, ResidualI8};

/// Time every operation of a model on a scene: median, multiply-adds per second, the share of this machine's own peak,
/// which is measured between the frames, and the longest slice when the frame is run in steps.
#[derive(Args, Debug)]
#[command(after_help = "\
Examples:
  voxcast profile --model model.safetensors scene/
  voxcast profile --model model.safetensors scene/ --repeat 5 --by kind
  voxcast profile --model model.safetensors scene/ --slice 20 --by part    (how long can one step take?)
  voxcast profile --model model.safetensors scene/ --trace trace.json    (open in chrome://tracing or Perfetto)

A step of a controller overruns its time by one slice at most. The column `slice` is the longest of each row, the median over
as many frames as are timed, the line at the end the longest of all. On a shared machine, it holds what others did meanwhile.
GMAC are billions of multiply-adds as the network has them; the share of the peak counts those that the kernels execute. For
models of int8 there are two peaks, of f32 and of bytes, and the share is the time that the work would take at them.

Keys of --json:
  frame_seconds                  median time of a whole frame
  threads                        threads that computed
  peak_multiply_adds_per_second  of all threads, register to register, measured between the frames
  integer_peak_multiply_adds_per_second
                                 of bytes, in the first-level cache; null where none are multiplied
  multiply_adds                  of a frame, as the network has them
  executed_multiply_adds         of a frame, as the kernels execute them
  integer_multiply_adds          those of them that are of bytes
  slices                         slices of a frame that is run in steps
  longest_slice_seconds          the longest of them
  longest_slice_operation        what it was a part of
  rows                           the table: of each name the median of its seconds in a frame, all cameras together, its
                                 longest_slice_seconds, multiply_adds, executed_multiply_adds and integer_multiply_adds")]
pub struct Profile {
    /// The model
    #[arg(long)]
    model: PathBuf,
    /// The scene's matrices: made by `voxcast rig`, or plain CSR of another program
    #[arg(long)]
    rig: Option<PathBuf>,
    /// Use that rig even if it was made from another calibration than the scene's
    #[arg(long, requires = "rig")]
    any_rig: bool,
    /// A scene directory or .safetensors
    scene: PathBuf,
    /// Frames to time, after one that is not
    #[arg(long, value_name = "N", default_value_t = 3, value_parser = clap::value_parser!(u16).range(1..=1000))]
    repeat: u16,
    /// Rows of the table: every operation, or sums over part of the network or kind of operation
    #[arg(long, default_value = "operation", value_parser = ["operation", "part", "kind"])]
    by: String,
    /// Run without the projection fold
    #[arg(long)]
    unfolded: bool,
    /// Work in one slice of a step, in million multiply-adds; a slice is at least one tile for each thread
    #[arg(long, value_name = "MILLIONS", default_value_t = 50, value_parser = clap::value_parser!(u32).range(1..))]
    slice: u32,
    /// Write the last frame as a Chrome trace
    #[arg(long, value_name = "FILE")]
    trace: Option<PathBuf>,
    /// Print as JSON
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    machine: Machine,
}

/// Seconds of one operation in each frame, all cameras together.
struct Row {
    name: String,
    seconds: Vec<f64>,
    /// Of the longest slice.
    slice: f64,
    /// As the network has them.
    multiply_adds: u64,
    /// As the kernels execute them, in f32 and of bytes.
    executed: [u64; 2],
}

/// Frames in slices.
struct Sliced {
    /// Seconds of the longest slice of each operation, frame by frame.
    longest: Vec<Vec<f64>>,
    /// Slices of a frame.
    slices: usize,
}

impl Profile {
    pub fn run(self) -> Result<()> {
        let inputs = [Some(&self.model), self.rig.as_ref(), Some(&self.scene)];
        let inputs = ["--model", "--rig", "SCENE"].into_iter().zip(inputs);
        let trace = self.trace.iter().map(|path| ("--trace", path));
        frame::check_outputs(inputs.filter_map(|(name, path)| Some((name, path?))), trace)?;
        let (model, scene, notes) = frame::open(&self.model, &self.scene)?;
        terminal::say(&notes);
        let mut options = frame::options(&self.machine)?;
        options.unfolded = self.unfolded;
        options.slice_cost = u64::from(self.slice) * 1_000_000;
        let file = frame::RigFile { path: self.rig.as_deref(), any: self.any_rig };
        let (rig, notes) = frame::rig(file, &model, &scene, &options)?;
        terminal::say(&notes);
        let mut session = frame::session(&model, Arc::new(rig), &options)?;
        let graph = session.graph().clone();
        let images = views(&scene);
        let index_of: BTreeMap<&str, usize> =
            graph.operations.iter().enumerate().map(|(i, o)| (o.name.as_str(), i)).collect();
        let repeat = usize::from(self.repeat);
        let mut seconds = vec![vec![0.0f64; repeat + 1]; graph.operations.len()];
        // Of multiply-adds in f32, and of bytes if there are any.
        let integers = model.quantisation().is_some();
        let mut peaks = [vec![], vec![]];
        let mut frames = vec![];
        let mut trace = vec![];
        let bar = terminal::progress("profiling", 2 * repeat + 1);
        for round in 0..=repeat {
            peaks[0].push(peak(options.isa, &options.threads, |isa| floats(isa, FLOAT_ROUNDS)));
            if integers {
                peaks[1].push(peak(options.isa, &options.threads, bytes));
            }
            trace.clear();
            let start = Instant::now();
            session.run_observed(&images, &mut |event| {
                let index = index_of[event.operation.name.as_str()];
                seconds[index][round] += event.elapsed.as_secs_f64();
                trace.push((index, event.camera, start.elapsed(), event.elapsed));
            })?;
            frames.push(start.elapsed().as_secs_f64());
            bar.inc(1);
        }
        let mut sliced = Sliced { longest: vec![vec![]; graph.operations.len()], slices: 0 };
        for _ in 0..repeat {
            sliced.frame(&mut session, &images, &index_of)?;
            bar.inc(1);
        }
        bar.finish_and_clear();
        if let Some(path) = &self.trace {
            write_trace(path, &graph, &trace)?;
        }
        let peaks = peaks.map(|mut peaks| peaks.get_mut(1..).map(median));
        let frame = median(&mut frames[1..]);
        let longest: Vec<f64> = sliced.longest.iter_mut().map(|frames| median(frames)).collect();
        let rows = self.rows(&graph, &seconds, &longest, images.len());
        let worst = (0..longest.len()).max_by(|&a, &b| longest[a].total_cmp(&longest[b]));
        let worst = worst.map_or("", |index| &graph.operations[index].name);
        self.print(rows, frame, peaks, options.threads.count(), sliced.slices, worst)?;
        Ok(())
    }

    /// Table rows in running order.
    fn rows(&self, graph: &Graph, seconds: &[Vec<f64>], longest: &[f64], cameras: usize) -> Vec<Row> {
        let mut rows: Vec<Row> = vec![];
        for (i, operation) in graph.operations.iter().enumerate() {
            let name = match self.by.as_str() {
                "kind" => operation.op.description().kind().to_owned(),
                "part" => graph.tensor(operation.output()).section.to_string(),
                _ => operation.name.clone(),
            };
            let times = if i < graph.camera_operations { cameras as u64 } else { 1 };
            let work = graph.multiply_adds(operation) * times;
            let mut executed = [0; 2];
            executed[usize::from(is_integer(graph, operation))] = graph.executed_multiply_adds(operation) * times;
            let slice = longest[i];
            match rows.iter_mut().find(|r| r.name == name) {
                Some(row) => {
                    row.multiply_adds += work;
                    row.executed.iter_mut().zip(executed).for_each(|(sum, work)| *sum += work);
                    row.slice = row.slice.max(slice);
                    row.seconds.iter_mut().zip(&seconds[i][1..]).for_each(|(sum, s)| *sum += s);
                }
                None => {
                    let seconds = seconds[i][1..].to_vec();
                    rows.push(Row { name, seconds, slice, multiply_adds: work, executed });
                }
            }
        }
        rows
    }

    fn print(
        &self,
        rows: Vec<Row>,
        frame: f64,
        peaks: [Option<f64>; 2],
        threads: usize,
        slices: usize,
        worst: &str,
    ) -> Result<()> {
        let total: u64 = rows.iter().map(|r| r.multiply_adds).sum();
        let total_executed = [0, 1].map(|kind| rows.iter().map(|r| r.executed[kind]).sum::<u64>());
        let longest = rows.iter().map(|r| r.slice).fold(0.0, f64::max);
        let rows: Vec<_> = rows.into_iter().map(|mut r| (median(&mut r.seconds), r)).collect();
        if self.json {
            let rows: Vec<_> = rows
                .iter()
                .map(|(seconds, row)| {
                    serde_json::json!({
                        "name": row.name, "seconds": seconds, "longest_slice_seconds": row.slice,
                        "multiply_adds": row.multiply_adds, "executed_multiply_adds": row.executed.iter().sum::<u64>(),
                        "integer_multiply_adds": row.executed[1],
                    })
                })
                .collect();
            let value = serde_json::json!({
                "frame_seconds": frame, "threads": threads,
                "peak_multiply_adds_per_second": peaks[0], "integer_peak_multiply_adds_per_second": peaks[1],
                "multiply_adds": total, "executed_multiply_adds": total_executed.iter().sum::<u64>(),
                "integer_multiply_adds": total_executed[1], "rows": rows, "slices": slices,
                "longest_slice_seconds": longest, "longest_slice_operation": worst,
            });
            return tell!("{value:#}");
        }
        tell!(
            "{:58} {:>10} {:>6} {:>9} {:>9} {:>6} {:>10}",
            self.by,
            "median",
            "share",
            "GMAC",
            "GMAC/s",
            "peak",
            "slice"
        )?;
        for (s, Row { name, slice, multiply_adds: work, executed, .. }) in &rows {
            let rate = *work as f64 / s;
            let (gmac, rate, share) = if *work == 0 {
                (String::new(), String::new(), String::new())
            } else {
                let gmac = format!("{:.3}", *work as f64 / 1e9);
                let share = at_peak(executed, &peaks) / s;
                (gmac, format!("{:.1}", rate / 1e9), format!("{:.0} %", 100.0 * share))
            };
            tell!(
                "{name:58} {:>10} {:>5.1}% {gmac:>9} {rate:>9} {share:>6} {:>10}",
                terminal::time(Duration::from_secs_f64(*s)),
                100.0 * s / frame,
                terminal::time(Duration::from_secs_f64(*slice))
            )?;
        }
        tell!(
            "frame {} on {threads} threads, {:.1} GMAC, {:.1} GMAC/s, {:.0} % of the measured peak of {}",
            terminal::time(Duration::from_secs_f64(frame)),
            total as f64 / 1e9,
            total as f64 / frame / 1e9,
            100.0 * at_peak(&total_executed, &peaks) / frame,
            match peaks {
                [Some(floats), Some(bytes)] => {
                    format!("{:.1} GMAC/s in f32 and {:.1} GMAC/s of bytes", floats / 1e9, bytes / 1e9)
                }
                [peak, _] => format!("{:.1} GMAC/s", peak.unwrap_or_default() / 1e9),
            }
        )?;
        tell!(
            "in steps: {slices} slices of about {} million multiply-adds, the longest {} in {worst}",
            self.slice,
            terminal::time(Duration::from_secs_f64(longest))
        )
    }
}

impl Sliced {
    /// Runs a frame slice by slice.
    fn frame(
        &mut self,
        session: &mut Session,
        images: &[ImageView<'_>],
        index_of: &BTreeMap<&str, usize>,
    ) -> Result<()> {
        for (camera, image) in images.iter().enumerate() {
            session.set_camera(camera, *image)?;
        }
        self.slices = 1;
        self.longest.iter_mut().for_each(|frames| frames.push(0.0));
        let mut observe = |event: Event<'_>| {
            if let Some(longest) = self.longest[index_of[event.operation.name.as_str()]].last_mut() {
                *longest = longest.max(event.longest.as_secs_f64());
            }
        };
        while session.step_observed(Budget::Slices(1), &mut observe) == Step::Running {
            self.slices += 1;
        }
        Ok(())
    }
}

/// Whether an operation multiplies bytes.
fn is_integer(graph: &Graph, operation: &Operation) -> bool {
    graph.tensor(operation.inputs[0]).element == Element::I8
}

/// Seconds that so many multiply-adds in f32 and of bytes take at this machine's peaks.
fn at_peak(executed: &[u64; 2], peaks: &[Option<f64>; 2]) -> f64 {
    executed.iter().zip(peaks).filter_map(|(&work, peak)| Some(work as f64 / (*peak)?)).sum()
}

/// Multiply-adds per second of all threads together, each of which does `work` and says how many they were.
fn peak(isa: Isa, threads: &Threads, work: impl Fn(Isa) -> u64 + Sync) -> f64 {
    let start = Instant::now();
    let work: u64 = threads.broadcast(|| work(isa)).into_iter().sum();
    work as f64 / start.elapsed().as_secs_f64()
}

/// Rounds of [`floats`] on vectors.
const FLOAT_ROUNDS: usize = 4_000_000;

/// Fused multiply-adds that never leave the registers.
fn floats(isa: Isa, rounds: usize) -> u64 {
    let rounds = if isa == Isa::Scalar { rounds / 20 } else { rounds };
    voxcast_kernels::peak::multiply_adds(isa, rounds).0
}

/// Products of bytes that never leave the first-level cache.
fn bytes(isa: Isa) -> u64 {
    const SIDE: usize = 96;
    const DEPTH: usize = 128;
    const COLUMNS: usize = 32;
    let repeat = if isa == Isa::Scalar { 20 } else { 2000 };
    let mut weights = vec![0; packed_len(DEPTH, COLUMNS)];
    layout::pack(DEPTH, COLUMNS, |k, n| ((k * 7 + n * 3) % 100) as i8 - 50, &mut weights);
    let sums: Vec<i32> = layout::sums(&weights, DEPTH).collect();
    let pairs: Vec<u8> = layout::pairs(&weights, DEPTH).collect();
    let (input, ends) = (vec![3; SIDE * DEPTH], vec![1 << 20; COLUMNS]);
    let one = [1; 3];
    let extent = [1, 1, SIDE];
    let geometry = Geometry {
        input: extent,
        channels: DEPTH,
        kernel: one,
        stride: one,
        dilation: one,
        padding: [0; 3],
        output: extent,
    };
    let product = ProductI8 {
        weights: &weights,
        sums: &sums,
        pairs: &pairs,
        bias: &ends,
        depth: DEPTH,
        columns: COLUMNS,
        signed: false,
        relu: true,
        residual: ResidualI8::None,
        multiplier: &ends,
    };
    let args = ConvI8 { geometry, input: &input, product };
    let (mut out, mut scratch) = (vec![0; SIDE * COLUMNS], vec![0; scratch_len(DEPTH, COLUMNS)]);
    for _ in 0..repeat {
        conv_i8(isa, std::hint::black_box(&args), 0..SIDE, COLUMNS, &mut out, &mut scratch);
    }
    (repeat * SIDE * DEPTH * COLUMNS) as u64
}

fn median(values: &mut [f64]) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

/// Chrome's trace event format: one complete event per operation, one row per camera.
fn write_trace(path: &Path, graph: &Graph, trace: &[(usize, Option<usize>, Duration, Duration)]) -> Result<()> {
    let events: Vec<_> = trace
        .iter()
        .map(|(index, camera, end, elapsed)| {
            let operation = &graph.operations[*index];
            serde_json::json!({
                "name": operation.name, "cat": operation.op.description().kind(), "ph": "X", "pid": 0,
                "tid": camera.map_or("frame".to_owned(), |c| format!("camera {c}")),
                "ts": end.saturating_sub(*elapsed).as_secs_f64() * 1e6, "dur": elapsed.as_secs_f64() * 1e6,
                "args": {"multiply_adds": graph.multiply_adds(operation)},
            })
        })
        .collect();
    let text = serde_json::json!({"traceEvents": events}).to_string();
    std::fs::write(path, text).map_err(|e| Error::io(path, "write", &e))
}
