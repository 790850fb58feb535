//! Evaluations: at once, or frame by frame on many machines.

use crate::error::{Failure, Outcome, own, warn};
use crate::machine;
use crate::model::Model;
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use std::path::PathBuf;
use std::sync::{Arc, Mutex};
use voxcast::dataset::Named;
use voxcast::eval::{self, Journal, Means, Predictor, Scope, Shard, Summary, Totals, write_text};
use voxcast::note::Said;
use voxcast::{Error, ErrorKind, SessionOptions};

/// One model, or two that are compared, on a data set with labels.
///
/// Evaluation(models, data, *, losses=False, calibration=False, limit=None, shard=None, resume=None)
///
/// models: one or two. data: a set as on the command line, such as "synthetic:heldout". shard: "I/N", of which frames I,
/// I + N, ... are this one's. resume: the journal that keeps every frame's score.
#[pyclass(frozen, module = "voxcast")]
pub(crate) struct Evaluation {
    evaluation: Arc<eval::Evaluation>,
    state: Mutex<State>,
}

struct State {
    totals: Totals,
    journal: Option<Journal>,
}

#[pymethods]
impl Evaluation {
    #[new]
    #[allow(clippy::too_many_arguments, reason = "Python's keyword arguments")]
    #[pyo3(signature = (models, data, *, losses = false, calibration = false, limit = None, shard = None, resume = None))]
    fn new(
        py: Python<'_>,
        models: Vec<Py<Model>>,
        data: &str,
        losses: bool,
        calibration: bool,
        limit: Option<usize>,
        shard: Option<&str>,
        resume: Option<PathBuf>,
    ) -> Outcome<Self> {
        if !matches!(models.len(), 1 | 2) {
            let message = format!("models: found {}, expected one, or two to compare", models.len());
            return Err(PyValueError::new_err(message).into());
        }
        check_limit(limit)?;
        let named: Named = data.parse().map_err(|e| PyValueError::new_err(format!("data {data:?}: {e}")))?;
        let shard = shard.map_or(Ok(Shard::WHOLE), str::parse)?;
        let scope = Scope { losses, calibration, limit, shard, ..Scope::default() };
        let predictors = models.iter().map(|model| Predictor::model(model.get().model.clone())).collect();
        let mut raised = None;
        let made = py.detach(|| -> voxcast::Result<Self> {
            let evaluation = eval::Evaluation::new(named.open()?, data, predictors, &scope)?;
            let mut totals = evaluation.totals();
            let mut watch = |_| {
                Python::attach(|py| py.check_signals()).map_err(|error| {
                    raised = Some(error);
                    Error::new(ErrorKind::Unsupported, "the journal was not read to its end")
                })
            };
            let journal = resume.map(|path| evaluation.resume(&path, &mut totals, &mut watch)).transpose()?;
            Ok(Self { evaluation: Arc::new(evaluation), state: Mutex::new(State { totals, journal }) })
        });
        match raised {
            Some(error) => Err(Failure::Python(error)),
            None => Ok(made?),
        }
    }

    /// The frames that have no score yet, in the order of the set.
    #[getter]
    fn left(&self) -> Outcome<Vec<usize>> {
        Ok(self.evaluation.left(&own(&self.state, "evaluation")?.totals))
    }

    /// Scores the frames that are left, `workers` at a time with `threads` in all. `watch` is called with the number of
    /// frames done, a few times a second; what it raises ends the evaluation.
    #[pyo3(signature = (*, workers = None, threads = None, isa = None, watch = None))]
    fn run(
        &self,
        py: Python<'_>,
        workers: Option<usize>,
        threads: Option<usize>,
        isa: Option<&str>,
        watch: Option<Py<PyAny>>,
    ) -> Outcome {
        let workers = workers.unwrap_or(Means::WORKERS);
        if workers == 0 {
            return Err(PyValueError::new_err("workers: found 0, expected at least 1").into());
        }
        let means = Means { workers, threads: machine::count(threads)?, isa: machine::isa(isa)? };
        let mut state = own(&self.state, "evaluation")?;
        let mut raised = None;
        let State { totals, journal } = &mut *state;
        let done = py.detach(|| {
            self.evaluation.run(&means, totals, journal.as_mut(), &mut |done, notes| {
                Python::attach(|py| {
                    let called = watch.as_ref().map_or(Ok(()), |watch| watch.call1(py, (done,)).map(drop));
                    // `evaluate` stands between this and who calls it.
                    let warned = warn(py, notes, 2);
                    py.check_signals().and(called).and(warned).map_err(|error| {
                        raised = Some(error);
                        Error::new(ErrorKind::Unsupported, "the evaluation was interrupted")
                    })
                })
            })
        });
        match raised {
            Some(error) => Err(Failure::Python(error)),
            None => Ok(done?),
        }
    }

    /// Counts a frame that a Worker scored, here or elsewhere: the line that it returned. False if the frame has been counted.
    fn add(&self, py: Python<'_>, line: &str) -> Outcome<bool> {
        let mut state = own(&self.state, "evaluation")?;
        let State { totals, journal } = &mut *state;
        Ok(py.detach(|| self.evaluation.add(totals, journal.as_mut(), line))?)
    }

    /// The numbers of the frames that have been counted.
    fn report(&self, py: Python<'_>) -> Outcome<Report> {
        let totals = own(&self.state, "evaluation")?.totals.clone();
        Ok(Report { summary: py.detach(|| self.evaluation.summary(totals)) })
    }

    fn __repr__(&self) -> String {
        format!("Evaluation({} on {})", self.evaluation.what().predictors.join(", "), self.evaluation.what().data)
    }
}

/// Scores single frames of an evaluation, with sessions of its own.
///
/// Worker(evaluation, *, threads=None, isa=None)
#[pyclass(frozen, module = "voxcast")]
pub(crate) struct Worker {
    worker: Mutex<eval::Worker>,
    said: Mutex<Said>,
}

#[pymethods]
impl Worker {
    #[new]
    #[pyo3(signature = (evaluation, *, threads = None, isa = None))]
    fn new(evaluation: &Evaluation, threads: Option<usize>, isa: Option<&str>) -> Outcome<Self> {
        let (threads, isa) = (machine::threads(threads)?, machine::isa(isa)?);
        let worker = eval::Worker::new(evaluation.evaluation.clone(), isa, threads);
        Ok(Self { worker: Mutex::new(worker), said: Mutex::default() })
    }

    /// The score of frame `index` of the set as a line of JSON: counts, losses in bits, and the digests of what was predicted.
    /// Every machine gives the same line.
    fn score(&self, py: Python<'_>, index: usize) -> Outcome<String> {
        let mut worker = own(&self.worker, "worker")?;
        let worker = &mut *worker;
        let line = py.detach(|| worker.score(index)?.to_line())?;
        let notes = worker.take_notes();
        warn(py, own(&self.said, "worker")?.fresh(notes), 1)?;
        Ok(line)
    }
}

/// The numbers of an evaluation.
#[pyclass(frozen, module = "voxcast")]
pub(crate) struct Report {
    summary: Summary,
}

#[pymethods]
impl Report {
    /// Frames that were scored.
    #[getter]
    fn frames(&self) -> usize {
        self.summary.frames()
    }

    /// IoU of "occupied" over all voxels, 0 to 1, of the first model; None if nothing is.
    #[getter]
    fn iou(&self) -> Option<f64> {
        self.summary.total.scores.first().and_then(|score| score.region(0).iou())
    }

    /// The mean IoU of the classes over all voxels, 0 to 1, of the first model.
    #[getter]
    fn miou(&self) -> Option<f64> {
        self.summary.total.scores.first().and_then(|score| score.region(0).mean_iou())
    }

    /// Of all predictions of each model in the order of the set: the same on every machine.
    #[getter]
    fn digests(&self) -> Vec<String> {
        self.summary.total.digests.iter().map(|digest| format!("{digest:016x}")).collect()
    }

    /// All ratios and counts, as `voxcast eval --json` writes them.
    fn to_dict<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        py.import("json")?.call_method1("loads", (self.summary.json().to_string(),))
    }

    /// Writes the file that `voxcast eval --json` writes.
    fn write_json(&self, path: PathBuf) -> Outcome {
        Ok(self.summary.write_json(&path)?)
    }

    /// Writes the tables as Markdown.
    fn write_markdown(&self, path: PathBuf) -> Outcome {
        Ok(write_text(&path, &self.summary.markdown())?)
    }

    /// Draws the confusion matrix as a PNG; of two models, that of the first one's classes with the second's.
    fn write_confusion(&self, path: PathBuf) -> Outcome {
        Ok(self.summary.write_confusion(&path)?)
    }

    /// Draws the reliability diagram as a PNG: of "occupied" and of the class, or of two models of "occupied". Of an evaluation
    /// with calibration=True.
    fn write_reliability(&self, path: PathBuf) -> Outcome {
        Ok(self.summary.write_reliability(&path)?)
    }

    fn __str__(&self) -> String {
        self.summary.text()
    }

    fn __repr__(&self) -> String {
        let percent = |value: Option<f64>| value.map_or("-".to_owned(), |value| format!("{:.2} %", 100.0 * value));
        format!("Report({} frames, IoU {}, mIoU {})", self.frames(), percent(self.iou()), percent(self.miou()))
    }

    /// For notebooks: the tables.
    fn _repr_markdown_(&self) -> String {
        self.summary.markdown()
    }
}

/// Refuses to score no frame at all.
fn check_limit(limit: Option<usize>) -> Outcome {
    match limit {
        Some(0) => Err(PyValueError::new_err("limit: found 0, expected at least 1").into()),
        _ => Ok(()),
    }
}

/// Fits the temperature of a model's probabilities to a set with labels, which training has not seen, and writes the model with
/// it to `output`, which may be its own file. Classes and logits stay as they are. Returns the model that was written.
///
/// data: as for evaluate. limit: only the first frames. Every frame is run some five times. isa: as for Session.
#[pyfunction]
#[pyo3(signature = (model, data, output, *, limit = None, threads = None, isa = None))]
pub(crate) fn calibrate_confidence(
    py: Python<'_>,
    model: &Model,
    data: &str,
    output: PathBuf,
    limit: Option<usize>,
    threads: Option<usize>,
    isa: Option<&str>,
) -> Outcome<Model> {
    check_limit(limit)?;
    let named: Named = data.parse().map_err(|e| PyValueError::new_err(format!("data {data:?}: {e}")))?;
    let (threads, isa) = (machine::threads(threads)?, machine::isa(isa)?);
    let options = SessionOptions { isa, threads, ..SessionOptions::default() };
    let (mut raised, mut said) = (None, Said::default());
    let done = py.detach(|| -> voxcast::Result<voxcast::Model> {
        let set = named.open()?;
        let fit = eval::fit_temperature(&model.model, &*set, data, limit, &options, &mut |_, notes| {
            Python::attach(|py| {
                let warned = warn(py, said.fresh(notes.to_vec()), 1);
                py.check_signals().and(warned).map_err(|error| {
                    raised = Some(error);
                    Error::new(ErrorKind::Unsupported, "the fit was interrupted")
                })
            })
        })?;
        model.model.save_with_temperature(fit.temperature, &output)?;
        voxcast::Model::open(&output)
    });
    match raised {
        Some(error) => Err(Failure::Python(error)),
        None => Ok(Model::of(done?)),
    }
}

/// Puts the journals of shards together: exactly the numbers of one run.
#[pyfunction]
#[pyo3(signature = (journals, *, limit = None))]
pub(crate) fn merge(py: Python<'_>, journals: Vec<PathBuf>, limit: Option<usize>) -> Outcome<Report> {
    check_limit(limit)?;
    Ok(Report { summary: py.detach(|| Summary::merge(&journals, limit))? })
}
