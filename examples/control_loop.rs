//! A control loop of a fixed rate that sees by `Session::step`: `cargo run --release --example control_loop`.
//!
//! Six cameras deliver images from threads of their own, one by one. Every cycle takes those that have come, gives
//! perception its share of the time, and decides on the last complete result; it knows how old what it sees is. The network
//! is small, its weights are drawn, and so is the street: what it decides means nothing, how long it takes does.
//!
//! ```text
//! control_loop [PERIOD] [BUDGET] [CYCLES]    milliseconds of a cycle and of perception in it [default: 20 12 200]
//! ```
#![allow(clippy::print_stdout, reason = "a program talks to its user")]

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};
use voxcast::import::import;
use voxcast::rig::RigBuilder;
use voxcast::seeded::SeededWeights;
use voxcast::synth::Synthesiser;
use voxcast::{Budget, ImageView, Isa, Model, Network, Occupancy, Scene, Session, SessionOptions, Step};

/// Time from one image of a camera to its next.
const INTERVAL: Duration = Duration::from_millis(150);

/// Frames that run before the loop begins.
const WARM_UP: u64 = 8;

/// Cameras of the network.
const CAMERAS: usize = 6;

/// Cycles of a line of the table.
const LINE: usize = 25;

type Failure = Box<dyn std::error::Error>;

fn main() -> Result<(), Failure> {
    let [period, budget, cycles] = arguments()?;
    let (period, budget) = (Duration::from_millis(period), Duration::from_millis(budget));
    let (mut session, scenes) = prepare()?;

    // A step is late by a slice at most, which has to fit into what perception leaves of the cycle.
    let slice = longest_slice(&mut session, &scenes[0])?;
    let slack = period - budget;
    if slice > slack {
        return Err(format!(
            "a slice takes {slice:.1?}, and a cycle has {slack:.1?} beside perception: lower `slice_cost` or the budget"
        )
        .into());
    }
    println!("a cycle of {period:?}, {budget:?} of it for perception; slices of up to {slice:.1?}\n");

    let mailboxes: Vec<Mailbox> = scenes[0].images.iter().map(|i| Mailbox::new(i.bgr.len())).collect();
    let mut controller = Controller::new(session, cycles as usize);
    let mut records = Vec::with_capacity(cycles as usize);
    let stop = AtomicBool::new(false);
    std::thread::scope(|scope| {
        for (camera, mailbox) in mailboxes.iter().enumerate() {
            let (scenes, stop) = (&scenes, &stop);
            scope.spawn(move || deliver(camera, scenes, mailbox, stop));
        }
        let start = Instant::now();
        let result = (0..cycles as u32).try_for_each(|cycle| {
            // On a grid of its own, so that a late cycle does not delay those after it.
            let begin = start + cycle * period;
            std::thread::sleep(begin.saturating_duration_since(Instant::now()));
            records.push(controller.cycle(&mailboxes, begin, budget)?);
            Ok::<_, Failure>(())
        });
        stop.store(true, Ordering::Relaxed);
        result
    })?;
    // Not before: a terminal can make a program wait.
    report(&records, period, &controller.session);
    Ok(())
}

fn arguments() -> Result<[u64; 3], Failure> {
    let mut values = [20, 12, 200];
    let given: Vec<String> = std::env::args().skip(1).collect();
    if given.len() > values.len() {
        return Err("usage: control_loop [PERIOD] [BUDGET] [CYCLES]".into());
    }
    for (value, text) in values.iter_mut().zip(&given) {
        *value = text.parse().map_err(|_| format!("{text}: expected a whole number"))?;
    }
    let [period, budget, cycles] = values;
    if budget == 0 || budget >= period || !(1..=100_000).contains(&cycles) {
        return Err(format!("{cycles} cycles of {period} ms with {budget} ms for perception cannot be").into());
    }
    Ok(values)
}

/// A session of a small network on this thread alone, and two moments of a street.
fn prepare() -> Result<(Session, [Scene; 2]), Failure> {
    let full = Network::built_in("nuscenes-200").expect("a built-in name");
    let network = Network {
        depths: [1; 4],
        width: 16,
        fpn: 32,
        channels: [8, 16, 24, 32],
        key_dims: [2, 3, 4],
        image: [64, 128],
        grids: [[32, 32, 4], [16, 16, 2], [8, 8, 1]],
        ..full
    };
    let directory = tempfile::tempdir()?;
    let path = directory.path().join("model.safetensors");
    import(&SeededWeights { seed: 3 }, &network, Default::default(), &path, &mut |_, _| ())?;
    let model = Arc::new(Model::open(&path)?);
    let synthesiser = Synthesiser::new(&network)?;
    let scenes = [1, 2].map(|seed| synthesiser.frame(seed).scene);
    let rig = RigBuilder::new(&network, network.cameras, Isa::best())?.build(&scenes[0].lidar2img)?;
    let options = SessionOptions { slice_cost: 5_000_000, ..SessionOptions::default() };
    Ok((Session::new(model, Arc::new(rig), &options)?, scenes))
}

/// The longest slice of a frame. Every frame is cut the same: of each slice the shortest time counts, so that what else the
/// machine does is left out.
fn longest_slice(session: &mut Session, scene: &Scene) -> Result<Duration, Failure> {
    let mut times: Vec<Duration> = vec![];
    for _ in 0..WARM_UP {
        for (camera, image) in scene.images.iter().enumerate() {
            session.set_camera(camera, ImageView::bgr(image.height, image.width, &image.bgr))?;
        }
        for slice in 0.. {
            let start = Instant::now();
            let step = session.step(Budget::Slices(1));
            let time = start.elapsed();
            match times.get_mut(slice) {
                Some(shortest) => *shortest = time.min(*shortest),
                None => times.push(time),
            }
            if step != Step::Running {
                break;
            }
        }
    }
    Ok(times.into_iter().max().unwrap_or_default())
}

/// Where a camera leaves its latest image.
struct Mailbox {
    bgr: Mutex<Vec<u8>>,
    is_new: AtomicBool,
}

impl Mailbox {
    fn new(bytes: usize) -> Self {
        Self { bgr: Mutex::new(vec![0; bytes]), is_new: AtomicBool::new(false) }
    }
}

/// The life of a camera: an image every [`INTERVAL`], at a moment of its own.
fn deliver(camera: usize, scenes: &[Scene], mailbox: &Mailbox, stop: &AtomicBool) {
    let mut due = Instant::now() + INTERVAL * camera as u32 / scenes[0].cameras() as u32;
    for scene in scenes.iter().cycle() {
        std::thread::sleep(due.saturating_duration_since(Instant::now()));
        if stop.load(Ordering::Relaxed) {
            return;
        }
        mailbox.bgr.lock().expect("no panic").copy_from_slice(&scene.images[camera].bgr);
        mailbox.is_new.store(true, Ordering::Release);
        due += INTERVAL;
    }
}

/// What a cycle came to.
struct Record {
    /// From the moment that the cycle was due to its end.
    time: Duration,
    /// Of it, perception.
    step: Duration,
    complete: bool,
    /// Time since each camera's image in the result came.
    ages: [Option<Duration>; CAMERAS],
    /// Voxels in the way.
    obstacles: usize,
}

struct Controller {
    session: Session,
    /// When each camera's images came.
    arrivals: [Vec<Instant>; CAMERAS],
}

impl Controller {
    fn new(session: Session, cycles: usize) -> Self {
        Self { session, arrivals: std::array::from_fn(|_| Vec::with_capacity(cycles)) }
    }

    /// One cycle. It neither waits nor allocates.
    fn cycle(&mut self, mailboxes: &[Mailbox], begin: Instant, budget: Duration) -> Result<Record, Failure> {
        let Self { session, arrivals } = self;
        let [height, width] = session.model().network().image;
        for (camera, mailbox) in mailboxes.iter().enumerate() {
            // An image that is just being written is there in the next cycle.
            if mailbox.is_new.load(Ordering::Acquire)
                && let Ok(bgr) = mailbox.bgr.try_lock()
            {
                session.set_camera(camera, ImageView::bgr(height, width, &bgr))?;
                mailbox.is_new.store(false, Ordering::Relaxed);
                arrivals[camera].push(Instant::now());
            }
        }
        let start = Instant::now();
        // A cycle that began late has less for perception.
        let left = budget.saturating_sub(start - begin);
        let complete = session.step(Budget::Time(left)) == Step::Complete;
        let step = start.elapsed();
        let mut ages = [None; CAMERAS];
        let mut obstacles = 0;
        if let Some(occupancy) = session.occupancy() {
            for ((age, camera), arrivals) in ages.iter_mut().zip(occupancy.cameras).zip(arrivals) {
                let image = camera.image.checked_sub(WARM_UP + 1).map(|image| arrivals[image as usize]);
                *age = image.map(|arrival| arrival.elapsed());
            }
            obstacles = in_the_way(&occupancy);
        }
        Ok(Record { time: begin.elapsed(), step, complete, ages, obstacles })
    }
}

/// Occupied voxels that a camera sees, in the lane ahead: what a controller would brake for.
fn in_the_way(occupancy: &Occupancy<'_>) -> usize {
    let [x, y, z] = occupancy.grid.size;
    let lane = (x / 2 - x / 32..x / 2 + x / 32).flat_map(|x| (y / 2..y).map(move |y| (x, y)));
    let voxels = lane.flat_map(|(i, j)| (0..z).map(move |k| (i * y + j) * z + k));
    voxels.filter(|&v| occupancy.classes[v] != 0 && occupancy.support[v] > 0).count()
}

fn report(records: &[Record], period: Duration, session: &Session) {
    let ms = |time: Duration| format!("{:.1} ms", time.as_secs_f64() * 1e3);
    println!("   cycles      mean   longest  deadline  missed  frames  in the way  milliseconds since the images came");
    for (line, records) in records.chunks(LINE).enumerate() {
        let times = || records.iter().map(|r| r.time);
        let last = records.last().expect("lines are not empty");
        let ages = last.ages.map(|age| age.map_or("-".to_owned(), |age| age.as_millis().to_string())).join(" ");
        println!(
            "{:>4}-{:<4} {:>9} {:>9} {:>9} {:>7} {:>7} {:>11}  {ages}",
            line * LINE,
            line * LINE + records.len() - 1,
            ms(times().sum::<Duration>() / records.len() as u32),
            ms(times().max().unwrap_or_default()),
            ms(period),
            times().filter(|&time| time > period).count(),
            records.iter().filter(|r| r.complete).count(),
            last.obstacles,
        );
    }
    let missed = records.iter().filter(|r| r.time > period).count();
    let step = records.iter().map(|r| r.step).max().unwrap_or_default();
    println!("\n{missed} of {} deadlines missed; the longest step took {}", records.len(), ms(step));
    if let Some((time, operation)) = session.longest_slice() {
        println!("the longest slice ever took {}, of {}", ms(time), operation.name);
    }
}
