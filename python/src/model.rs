//! Models, and how they are made of checkpoints.

use crate::error::{Failure, Outcome, warn};
use crate::machine;
use numpy::{PyReadonlyArrayDyn, PyUntypedArrayMethods};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::{PyBytes, PyDict};
use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use voxcast::checkpoint::Checkpoint;
use voxcast::graph::Rewrites;
use voxcast::import::{Integers, Source, import, import_int8_to_bytes, import_to_bytes};
use voxcast::model::Options;
use voxcast::model::ranges::Ranges;
use voxcast::model::unpacked::Unpacked;
use voxcast::network::BUILT_IN;
use voxcast::picture::Palette;
use voxcast::weights::Precision;
use voxcast::{Error, ErrorKind, Isa, Network, Threads, selftest};

/// The trained network that ships with voxcast (`docs/model-card.md`).
static EDGE: &[u8] = include_bytes!("../../assets/edge.safetensors");

/// The ranges of its tensors, measured on drawn streets (`docs/int8.md`).
static EDGE_RANGES: &str = include_str!("../../assets/edge.ranges.json");

/// A network with its weights, folded and packed as the kernels read them.
#[pyclass(frozen, module = "voxcast")]
pub(crate) struct Model {
    pub(crate) model: Arc<voxcast::Model>,
}

impl Model {
    pub(crate) fn of(model: voxcast::Model) -> Self {
        Self { model: Arc::new(model) }
    }
}

/// The network that ships in 8-bit integers, with its self-test.
fn in_integers(half: &voxcast::Model) -> voxcast::Result<voxcast::Model> {
    let ranges = Ranges::from_json(EDGE_RANGES, half.network())?;
    let integers = Integers { rewrites: Rewrites::ALL, ranges: &ranges, keep_f32: &[] };
    let bytes = import_int8_to_bytes(&Unpacked::new(half)?, half.network(), &integers, &mut |_, _| ())?;
    let model = Arc::new(voxcast::Model::from_bytes(bytes)?);
    voxcast::Model::from_bytes(selftest::record_to_bytes(&model, Isa::best(), &Threads::calling())?)
}

#[pymethods]
impl Model {
    /// Maps a model file and checks all of it. The file must not be changed while it is open; with copy=True it is copied
    /// into memory, and what was checked is what runs, whatever happens to the file.
    #[staticmethod]
    #[pyo3(signature = (path, *, copy = false))]
    fn open(py: Python<'_>, path: PathBuf, copy: bool) -> Outcome<Self> {
        let open = if copy { voxcast::Model::read } else { voxcast::Model::open };
        Ok(Self::of(py.detach(|| open(&path))?))
    }

    /// A model from the bytes of a file.
    #[staticmethod]
    fn from_bytes(py: Python<'_>, data: &[u8]) -> Outcome<Self> {
        let data = data.to_vec();
        Ok(Self::of(py.detach(|| voxcast::Model::from_bytes(data))?))
    }

    /// The small trained network that ships with voxcast, in f16 as it ships or in int8 as `voxcast demo` runs it. It has seen drawn
    /// streets only and is not for driving.
    #[staticmethod]
    #[pyo3(signature = (precision = "f16"))]
    fn shipped(py: Python<'_>, precision: &str) -> Outcome<Self> {
        let integers = match precision {
            "f16" => false,
            "int8" => true,
            _ => return Err(one_of("precision", precision, "\"f16\" or \"int8\"")),
        };
        let made = || {
            let half = voxcast::Model::from_bytes(EDGE)?;
            if integers { in_integers(&half) } else { Ok(half) }
        };
        Ok(Self::of(py.detach(made)?))
    }

    /// Writes the model, by way of a temporary file beside it.
    fn save(&self, py: Python<'_>, path: PathBuf) -> Outcome {
        Ok(py.detach(|| self.model.save(&path))?)
    }

    /// The bytes of the model's file.
    fn to_bytes<'py>(&self, py: Python<'py>) -> Bound<'py, PyBytes> {
        PyBytes::new(py, self.model.bytes())
    }

    /// The architecture: the keys of a network.json.
    #[getter]
    fn network<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        py.import("json")?.call_method1("loads", (self.model.network().to_json(),))
    }

    /// Voxels along x, y, z.
    #[getter]
    fn grid(&self) -> [usize; 3] {
        self.model.network().output_grid()
    }

    /// ((x min, x max), (y min, y max), (z min, z max)) in metres of the lidar's frame.
    #[getter]
    fn bounds(&self) -> [(f32, f32); 3] {
        self.model.network().bounds.map(|[low, high]| (low, high))
    }

    /// Height and width of images, padded to multiples of 32.
    #[getter]
    fn image_size(&self) -> (usize, usize) {
        let [height, width] = self.model.network().image;
        (height, width)
    }

    /// Cameras that the network was trained for.
    #[getter]
    fn cameras(&self) -> usize {
        self.model.network().cameras
    }

    /// Names of the classes; 0 is empty.
    #[getter]
    fn classes(&self) -> Vec<String> {
        let palette = Palette::of(self.model.network().classes);
        palette.classes().iter().map(|class| class.name.clone()).collect()
    }

    /// How weights are stored: "f32", "f16" or "int8".
    #[getter]
    fn precision(&self) -> &'static str {
        self.model.options().precision.name()
    }

    /// What logits are divided by before their softmax says how sure the network is; 1 unless `calibrate_confidence` has fitted it.
    #[getter]
    fn temperature(&self) -> f32 {
        self.model.temperature().value()
    }

    /// The file's checksum, as `voxcast inspect` prints it; None for a file that has none.
    #[getter]
    fn checksum(&self) -> Option<String> {
        self.model.checksum().map(|checksum| format!("{checksum:016x}"))
    }

    /// The file that it was opened from.
    #[getter]
    fn path(&self) -> Option<PathBuf> {
        self.model.path().map(Path::to_owned)
    }

    /// Checks that this machine computes what the model must give. Returns how many operations were compared; raises
    /// MismatchError naming the first that differs.
    #[pyo3(signature = (*, threads = None, isa = None))]
    fn selftest(&self, py: Python<'_>, threads: Option<usize>, isa: Option<&str>) -> Outcome<usize> {
        let (threads, isa) = (machine::threads(threads)?, machine::isa(isa)?);
        let report = py.detach(|| selftest::run(&self.model, isa, &threads))?;
        match report.fault {
            None => Ok(report.operations),
            Some(fault) => Err(Error::mismatch(fault.to_string()).into()),
        }
    }

    /// Pickled as the path of the file where there is one, else as the bytes.
    fn __reduce__<'py>(slf: &Bound<'py, Self>) -> PyResult<(Bound<'py, PyAny>, Bound<'py, PyAny>)> {
        let (py, class) = (slf.py(), slf.get_type());
        match slf.get().path() {
            Some(path) => Ok((class.getattr("open")?, (path,).into_pyobject(py)?.into_any())),
            None => Ok((class.getattr("from_bytes")?, (slf.get().to_bytes(py),).into_pyobject(py)?.into_any())),
        }
    }

    fn __repr__(&self) -> String {
        let [x, y, z] = self.grid();
        let of = self.model.path().map(|path| format!("{}, ", path.display())).unwrap_or_default();
        format!("Model({of}{x} x {y} x {z} voxels, {} classes, {})", self.model.network().classes, self.precision())
    }
}

/// The network of that name, or of that JSON file, as JSON.
#[pyfunction]
pub(crate) fn network_json(name: &str) -> Outcome<String> {
    if let Some(network) = Network::built_in(name) {
        return Ok(network.to_json());
    }
    let path = Path::new(name);
    if !path.exists() {
        let message = format!("network {name}: neither a file nor one of {}", BUILT_IN.join(", "));
        return Err(Error::new(ErrorKind::Io, message).into());
    }
    let text = std::fs::read_to_string(path).map_err(|e| Error::io(path, "read", &e))?;
    Ok(Network::from_json(&text).map_err(|e| e.in_file(path))?.to_json())
}

/// Imports a checkpoint file.
#[pyfunction]
pub(crate) fn import_file(py: Python<'_>, checkpoint: PathBuf, wish: Wish) -> Outcome<Model> {
    let plan = wish.plan()?;
    let (model, notes) = py.detach(|| -> Outcome<_> {
        let source = Checkpoint::open(&checkpoint)?;
        let model = plan.import(&source).map_err(|failure| match failure {
            Failure::Library(error) => Failure::Library(error.in_file(&checkpoint)),
            other => other,
        })?;
        let mut notes = source.notes();
        notes.extend(source.unused_note());
        Ok((model, notes))
    })?;
    // `import_checkpoint` stands between this and who calls it.
    warn(py, &notes, 2)?;
    Ok(model)
}

/// Imports a dict of float32 or float64 arrays.
#[pyfunction]
pub(crate) fn import_tensors(py: Python<'_>, tensors: &Bound<'_, PyDict>, wish: Wish) -> Outcome<Model> {
    let plan = wish.plan()?;
    let mut source = Tensors(HashMap::new());
    for (name, array) in tensors {
        source.0.insert(name.extract()?, Array::of(&array)?);
    }
    py.detach(|| plan.import(&source))
}

/// How a model is to be made, as `import_checkpoint` hands it on: the network as JSON, the output, precision, fold, whether
/// convolutions are direct sums, whether there is to be a self-test, and on how many threads.
#[derive(FromPyObject)]
pub(crate) struct Wish(String, Option<PathBuf>, String, String, bool, bool, Option<usize>);

/// How a model is made, and where it goes.
struct Plan {
    network: Network,
    options: Options,
    output: Option<PathBuf>,
    self_test: Option<voxcast::Threads>,
}

fn one_of(what: &str, found: &str, expected: &str) -> Failure {
    Failure::Python(PyValueError::new_err(format!("{what}: found {found:?}, expected {expected}")))
}

impl Wish {
    fn plan(self) -> Outcome<Plan> {
        let Self(network, output, precision, fold, exact, self_test, threads) = self;
        let network = Network::from_json(&network)?;
        let unknown = || one_of("precision", &precision, "\"f32\" or \"f16\"");
        // int8 needs ranges, which the command line measures.
        let precision = Precision::parse(&precision).filter(|&p| p != Precision::I8).ok_or_else(unknown)?;
        let rewrites = match fold.as_str() {
            "all" => Rewrites::ALL,
            "batch-norm" => Rewrites { projection: false, ..Rewrites::ALL },
            "none" => Rewrites::NONE,
            other => return Err(one_of("fold", other, "\"all\", \"batch-norm\" or \"none\"")),
        };
        let rewrites = Rewrites { winograd: rewrites.winograd && !exact, ..rewrites };
        let self_test = self_test.then(|| machine::threads(threads)).transpose()?;
        Ok(Plan { network, options: Options { precision, rewrites }, output, self_test })
    }
}

impl Plan {
    fn import(&self, source: &dyn Source) -> Outcome<Model> {
        let progress = &mut |_, _| ();
        let Some(output) = &self.output else {
            let bytes = import_to_bytes(source, &self.network, self.options, progress)?;
            return Ok(Model::of(voxcast::Model::from_bytes(bytes)?));
        };
        import(source, &self.network, self.options, output, progress)?;
        if let Some(threads) = &self.self_test {
            selftest::record(output, voxcast::Isa::best(), threads).map_err(|e| e.in_file(output))?;
        }
        Ok(Model::of(voxcast::Model::open(output)?))
    }
}

/// Weights from memory.
struct Tensors(HashMap<String, Array>);

/// An array in row-major order.
struct Array {
    shape: Vec<usize>,
    values: Values,
}

enum Values {
    F32(Vec<f32>),
    F64(Vec<f64>),
}

impl Array {
    fn of(array: &Bound<'_, PyAny>) -> Outcome<Self> {
        if let Ok(array) = array.extract::<PyReadonlyArrayDyn<'_, f32>>() {
            let values = Values::F32(array.as_array().iter().copied().collect());
            return Ok(Self { shape: array.shape().to_vec(), values });
        }
        let array: PyReadonlyArrayDyn<'_, f64> =
            array.extract().map_err(|_| crate::images::unfit("tensor", array, "float32 or float64"))?;
        Ok(Self { shape: array.shape().to_vec(), values: Values::F64(array.as_array().iter().copied().collect()) })
    }
}

impl Source for Tensors {
    fn tensor(&self, name: &str, shape: &[usize]) -> voxcast::Result<Vec<f64>> {
        let Some(tensor) = self.0.get(name) else {
            return Err(Error::format(format!("tensor \"{name}\" is missing, expected shape {shape:?}")));
        };
        if tensor.shape != shape {
            let found = &tensor.shape;
            let message = format!("tensor \"{name}\" has shape {found:?}, the network expects {shape:?}");
            return Err(Error::mismatch(message));
        }
        let values: Vec<f64> = match &tensor.values {
            Values::F32(values) => values.iter().copied().map(f64::from).collect(),
            Values::F64(values) => values.clone(),
        };
        match values.iter().position(|value| !value.is_finite()) {
            None => Ok(values),
            Some(at) => {
                let message = format!("tensor \"{name}\" is {} at {at}, expected finite numbers", values[at]);
                Err(Error::format(message))
            }
        }
    }
}
