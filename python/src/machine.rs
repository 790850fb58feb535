//! On what to compute. None of it changes a result.

use crate::error::Outcome;
use voxcast::{Error, ErrorKind, Isa, Threads};

/// Most threads that can be asked for.
const MOST: usize = 1024;

/// How many threads: as many as there are CPUs, if none are asked for.
pub(crate) fn count(threads: Option<usize>) -> Outcome<usize> {
    match threads {
        None => Ok(std::thread::available_parallelism().map_or(1, usize::from)),
        Some(count) if (1..=MOST).contains(&count) => Ok(count),
        Some(count) => Err(Error::mismatch(format!("threads: found {count}, expected 1 to {MOST}")).into()),
    }
}

/// As many threads.
pub(crate) fn threads(threads: Option<usize>) -> Outcome<Threads> {
    Ok(Threads::new(count(threads)?)?)
}

/// The instruction set of that name, or the fastest of this CPU.
pub(crate) fn isa(name: Option<&str>) -> Outcome<Isa> {
    let unsupported = |e: voxcast::IsaError| Error::new(ErrorKind::Unsupported, format!("isa: {e}"));
    Ok(name.map_or(Ok(Isa::best()), |name| Isa::parse(name).map_err(unsupported))?)
}
