//! Rigs as files: plain CSR tensors in safetensors, which other programs write too.

use super::calibration::Calibration;
use super::{Csr, Rig, Storage, Tensors};
use crate::base::error::{Error, ErrorKind, Result};
use crate::file::container::{self, Container, Data, Layout, Tensor};
use crate::network::Network;
use safetensors::Dtype;
use std::borrow::Cow;
use std::collections::BTreeMap;
use std::ops::Range;
use std::path::Path;

/// `"format"` of the files that [`Rig::save`] writes.
const RIG_FORMAT: &str = "voxcast-rig-1";

/// Metadata key of the [`Calibration`].
const CALIBRATION: &str = "calibration";

/// Tensors of a level, behind "level{1,2,3}.".
const NAMES: [&str; 4] = ["volume.ptr", "volume.col", "bev.ptr", "bev.col"];

impl Rig {
    /// Maps the rig at `path` and checks every number in it.
    ///
    /// It must hold `level{1,2,3}.{volume,bev}.{ptr,col}` as one-dimensional u32; other tensors and foreign metadata are
    /// ignored. A rig that [`Rig::save`] wrote must also be whole, by its checksum, and made for the same cameras, image,
    /// grids and sample points; a plain one cannot tell. Of which calibration it is, [`Rig::check_calibration`] compares.
    /// The file must not be changed while the rig lives.
    ///
    /// # Errors
    /// [`ErrorKind::Io`] if the file cannot be read; [`ErrorKind::Format`] if it is no rig or breaks a rule of
    /// [`Csr`]; [`ErrorKind::Mismatch`] if it is the rig of another network; [`ErrorKind::Unsupported`] if it has a
    /// format of another version. The message names tensor and row.
    pub fn open(path: &Path, network: &Network, cameras: usize) -> Result<Rig> {
        Container::open(path).and_then(|c| Rig::from_container(c, network, cameras)).map_err(|e| e.in_file(path))
    }

    /// Copies the rig at `path` into memory and checks the copy as [`Rig::open`] does: nothing that happens to the file
    /// later matters.
    ///
    /// # Errors
    /// As [`Rig::open`]; [`ErrorKind::TooLarge`] if the system has no memory for it.
    pub fn read(path: &Path, network: &Network, cameras: usize) -> Result<Rig> {
        Container::read(path).and_then(|c| Rig::from_container(c, network, cameras)).map_err(|e| e.in_file(path))
    }

    /// [`Rig::open`] of a container that is open already.
    ///
    /// # Errors
    /// As [`Rig::open`], without a file name.
    pub fn from_container(container: Container, network: &Network, cameras: usize) -> Result<Rig> {
        let calibration = check_metadata(container.metadata(), network, cameras)?;
        let mut ranges = Tensors::<Range<usize>>::default();
        let mut in_place = true;
        for l in 0..3 {
            let pixels = network.feature_pixels(l) as u64 * cameras as u64;
            let [x, y, z] = network.grids[l];
            let mut words: [Cow<'_, [u32]>; 4] = Default::default();
            for (t, name) in NAMES.iter().enumerate() {
                let bytes = tensor(&container, &format!("level{}.{name}", l + 1))?;
                let from = bytes.as_ptr() as usize - container.bytes().as_ptr() as usize;
                ranges[l][t] = from..from + bytes.len();
                words[t] = as_words(bytes);
                in_place &= matches!(words[t], Cow::Borrowed(_));
            }
            let [volume_ptr, volume_col, bev_ptr, bev_col] = &words;
            check_csr(&format!("level{}.volume", l + 1), Csr { ptr: volume_ptr, col: volume_col }, x * y * z, pixels)?;
            check_csr(&format!("level{}.bev", l + 1), Csr { ptr: bev_ptr, col: bev_col }, x * y, pixels)?;
        }
        let storage = if in_place {
            Storage::Mapped(container, ranges)
        } else {
            let bytes = container.bytes();
            Storage::Owned(ranges.map(|level| level.map(|r| as_words(&bytes[r]).into_owned())))
        };
        Ok(Rig { storage, cameras, calibration })
    }

    /// Writes the rig, which belongs to `network`, to `path` with a checksum.
    ///
    /// The file takes its name when it is complete; one that was there is replaced then.
    ///
    /// # Errors
    /// [`ErrorKind::Mismatch`] if the rows are not those of `network`; [`ErrorKind::Io`] if the system refuses.
    pub fn save(&self, path: &Path, network: &Network) -> Result<()> {
        let mut tensors = Vec::new();
        for l in 0..3 {
            let level = self.level(l);
            let [x, y, z] = network.grids[l];
            for (which, csr, rows) in [("volume", level.volume, x * y * z), ("bev", level.bev, x * y)] {
                check_rows(&format!("level{}.{which}.ptr", l + 1), csr.ptr.len(), rows).map_err(|e| e.in_file(path))?;
            }
            for (name, words) in NAMES.iter().zip([level.volume.ptr, level.volume.col, level.bev.ptr, level.bev.col]) {
                let data = Data::Bytes(bytemuck::cast_slice(words));
                let name = format!("level{}.{name}", l + 1);
                tensors.push(Tensor { name, dtype: Dtype::U32, shape: vec![words.len()], data });
            }
        }
        let mut metadata = BTreeMap::from([
            (container::FORMAT.to_owned(), RIG_FORMAT.to_owned()),
            ("network".to_owned(), network.to_json()),
            ("cameras".to_owned(), self.cameras().to_string()),
        ]);
        if self.calibration.is_known() {
            metadata.insert(CALIBRATION.to_owned(), self.calibration.to_string());
        }
        // Every tensor is of u32, so each starts on a multiple of 4 wherever the ones before it end.
        container::write(path, tensors, &metadata, Layout::Packed)
    }
}

/// Compares what a rig of our own says about itself, and gives the calibration that it was built from. Plain rigs say
/// nothing.
fn check_metadata(metadata: &BTreeMap<String, String>, network: &Network, cameras: usize) -> Result<Calibration> {
    match metadata.get(container::FORMAT).map(String::as_str) {
        Some(RIG_FORMAT) => {}
        Some(other) if other.starts_with("voxcast-rig-") => {
            let message = format!("format {other:?}, this version reads {RIG_FORMAT:?}");
            return Err(Error::new(ErrorKind::Unsupported, message));
        }
        Some(other) if other.starts_with(container::FORMAT_PREFIX) => {
            return Err(Error::mismatch(format!("a file of format {other:?}, expected a rig")));
        }
        _ => return Ok(Calibration::default()),
    }
    let get = |key: &str| metadata.get(key).ok_or_else(|| Error::format(format!("the metadata has no {key:?}")));
    let made_for = get("cameras")?;
    if *made_for != cameras.to_string() {
        return Err(Error::mismatch(format!("a rig of {made_for} cameras, expected {cameras}")));
    }
    let made = Network::from_json(get("network")?)?;
    for (key, found, expected) in [
        ("image", format!("{:?}", made.image), format!("{:?}", network.image)),
        ("strides", format!("{:?}", made.strides), format!("{:?}", network.strides)),
        ("bounds", format!("{:?}", made.bounds), format!("{:?}", network.bounds)),
        ("grids", format!("{:?}", made.grids), format!("{:?}", network.grids)),
        ("samples", format!("{:?}", made.samples), format!("{:?}", network.samples)),
        ("sampling", format!("{:?}", made.sampling), format!("{:?}", network.sampling)),
    ] {
        if found != expected {
            return Err(Error::mismatch(format!(
                "a rig of another network: its {key} is {found}, expected {expected}"
            )));
        }
    }
    metadata.get(CALIBRATION).map_or(Ok(Calibration::default()), |text| Calibration::parse(text, cameras))
}

/// The bytes of the one-dimensional u32 tensor `name`.
fn tensor<'a>(container: &'a Container, name: &str) -> Result<&'a [u8]> {
    let (dtype, shape, bytes) =
        container.tensor(name).ok_or_else(|| Error::format(format!("no tensor {name}: not a rig")))?;
    if dtype != Dtype::U32 || shape.len() != 1 {
        return Err(Error::format(format!("{name}: {dtype:?} of shape {shape:?}, expected U32 of one dimension")));
    }
    Ok(bytes)
}

/// Little-endian bytes as numbers: in place if they are aligned.
fn as_words(bytes: &[u8]) -> Cow<'_, [u32]> {
    match bytemuck::try_cast_slice(bytes) {
        Ok(words) => Cow::Borrowed(words),
        Err(_) => bytes.as_chunks().0.iter().map(|&b| u32::from_le_bytes(b)).collect(),
    }
}

fn check_rows(name: &str, len: usize, rows: usize) -> Result<()> {
    if len != rows + 1 {
        let found = len.saturating_sub(1);
        return Err(Error::mismatch(format!("a rig of another network: {name} has {found} rows, expected {rows}")));
    }
    Ok(())
}

/// Every rule of [`Csr`], and columns below `pixels`.
fn check_csr(name: &str, Csr { ptr, col }: Csr<'_>, rows: usize, pixels: u64) -> Result<()> {
    check_rows(&format!("{name}.ptr"), ptr.len(), rows)?;
    if ptr[0] != 0 {
        return Err(Error::format(format!("{name}.ptr: row 0 starts at entry {}, expected 0", ptr[0])));
    }
    if ptr[rows] as usize != col.len() {
        return Err(Error::format(format!(
            "{name}.ptr: the last row ends at entry {}, expected {}, the length of {name}.col",
            ptr[rows],
            col.len()
        )));
    }
    for (row, ends) in ptr.windows(2).enumerate() {
        let (from, to) = (ends[0] as usize, ends[1] as usize);
        if from > to || to > col.len() {
            return Err(Error::format(format!(
                "{name}.ptr: row {row} is entries {from} to {to}, expected an end from {from} to {}",
                col.len()
            )));
        }
        let mut least = 0u64;
        for &c in &col[from..to] {
            let c = u64::from(c);
            if c < least {
                let message = format!("{name}.col: row {row} holds {c} after {}, expected ascending pixels", least - 1);
                return Err(Error::format(message));
            }
            least = c + 1;
        }
        if least > pixels {
            return Err(Error::format(format!(
                "{name}.col: row {row} holds pixel {}, expected less than {pixels}",
                least - 1
            )));
        }
    }
    Ok(())
}
