//! `voxcast view`

use super::terminal::tell;
use super::{frame, import::read_network, terminal};
use clap::Args;
use std::path::{Path, PathBuf};
use voxcast::html::Page;
use voxcast::labels::read_labels;
use voxcast::network::Grid;
use voxcast::npz::{OwnedArray, OwnedElements, read_npz};
use voxcast::picture::{Class, Occupancy, Palette};
use voxcast::{Error, Network, Result, Scene};

/// Make a page of a result, to look at in a browser.
///
/// The page is one file that needs nothing else and asks no network for anything: voxels to turn and to slice, classes to
/// switch, what no camera sees, how likely a voxel must be to be shown (of a result of `run --confidence`), truth and
/// difference, camera images with the voxels on them.
#[derive(Args, Debug)]
#[command(after_help = "\
Examples:
  voxcast view out.npz
  voxcast view out.npz --scene scene/ --truth scene/labels.npz -o out.html
  voxcast view classes.npz --network nuscenes-200    # of another program, which wrote no `bounds`

Truth is `classes` u8 [X, Y, Z] in an .npz, 255 where there is no label, or integer rows x, y, z, class in an .npy, as
SurroundOcc publishes them: there, rows of class 0 mark voxels without a label.")]
pub struct View {
    /// The result to show: `classes` u8 [X, Y, Z], as `voxcast run` writes it
    #[arg(value_name = "OUT.npz")]
    result: PathBuf,
    /// The scene whose images to show: a directory or .safetensors
    #[arg(long)]
    scene: Option<PathBuf>,
    /// Labels to compare with
    #[arg(long, value_name = "LABELS")]
    truth: Option<PathBuf>,
    /// Where the .npz does not say it: whose bounds and classes these are, a built-in name or a network.json
    #[arg(long, value_name = "NAME|FILE.json")]
    network: Option<String>,
    /// The page to write [default: OUT.html beside OUT.npz]
    #[arg(short, long, value_name = "FILE.html")]
    output: Option<PathBuf>,
}

impl View {
    pub fn run(self) -> Result<()> {
        let output = self.output.unwrap_or_else(|| self.result.with_extension("html"));
        let inputs = [Some(&self.result), self.scene.as_ref(), self.truth.as_ref()];
        let inputs = ["OUT.npz", "--scene", "--truth"].into_iter().zip(inputs);
        frame::check_outputs(inputs.filter_map(|(name, path)| Some((name, path?))), [("--output", &output)])?;
        let network = self.network.as_deref().map(read_network).transpose()?;
        let stored = Stored::read(&self.result, network.as_ref()).map_err(|e| e.in_file(&self.result))?;
        let scene = self.scene.as_deref().map(Scene::open_with_notes).transpose()?;
        let scene = scene.map(|(scene, notes)| {
            terminal::say(&notes);
            scene
        });
        let truth = self.truth.as_deref().map(|path| read_labels(path, stored.grid.size)).transpose()?;
        let occupancy = stored.occupancy().map_err(|e| e.in_file(&self.result))?;
        let page = Page {
            title: &name_of(&self.result),
            subtitle: &self.scene.as_deref().map(name_of).unwrap_or_default(),
            prediction: occupancy,
            truth: truth.as_deref(),
            scene: scene.as_ref(),
            palette: &stored.palette,
        };
        page.write(&output).map_err(|e| if e.path().is_some() { e } else { e.in_file(&self.result) })?;
        let length = std::fs::metadata(&output).map_or(0, |m| m.len());
        tell!("{} of {}, to open in a browser", output.display(), terminal::bytes(length as usize))?;
        Ok(())
    }
}

/// A file's own name.
pub fn name_of(path: &Path) -> String {
    path.file_name().unwrap_or(path.as_os_str()).to_string_lossy().into_owned()
}

/// What a result's file says, and a network where it does not.
struct Stored {
    classes: Vec<u8>,
    support: Vec<u16>,
    confidence: Vec<u8>,
    grid: Grid,
    palette: Palette,
}

impl Stored {
    fn read(path: &Path, network: Option<&Network>) -> Result<Self> {
        let arrays = read_npz(path)?;
        let find = |name: &str| arrays.iter().find(|a| a.name == name);
        let (size, classes) = match find("classes") {
            Some(OwnedArray { shape, elements: OwnedElements::U8(classes), .. }) if shape.len() == 3 => {
                ([shape[0], shape[1], shape[2]], classes.clone())
            }
            Some(other) => return Err(unfit(other, "u8 [X, Y, Z]")),
            None => return Err(Error::format("no array \"classes\", expected u8 [X, Y, Z]")),
        };
        let support = match find("support") {
            Some(OwnedArray { shape, elements: OwnedElements::U16(support), .. }) if *shape == size => support.clone(),
            Some(other) => return Err(unfit(other, &format!("u16 {size:?}"))),
            None => Vec::new(),
        };
        let confidence = match find("confidence_occupied") {
            Some(OwnedArray { shape, elements: OwnedElements::U8(codes), .. }) if *shape == size => codes.clone(),
            Some(other) => return Err(unfit(other, &format!("u8 {size:?}"))),
            None => Vec::new(),
        };
        if let Some(network) = network.filter(|network| network.output_grid() != size) {
            let message = format!("a grid of {size:?}, that of --network has {:?}", network.output_grid());
            return Err(Error::mismatch(message));
        }
        let bounds = match (find("bounds"), network) {
            (Some(OwnedArray { shape, elements: OwnedElements::F32(b), .. }), _) if shape[..] == [3, 2] => {
                [[b[0], b[1]], [b[2], b[3]], [b[4], b[5]]]
            }
            (Some(other), _) => return Err(unfit(other, "f32 [3, 2]")),
            (None, Some(network)) => network.bounds,
            (None, None) => {
                let message = "no array \"bounds\", expected f32 [3, 2], or --network to say whose result this is";
                return Err(Error::format(message));
            }
        };
        let palette = match (find("colours"), network) {
            (Some(OwnedArray { shape, elements: OwnedElements::U8(rgb), .. }), _)
                if shape.len() == 2 && (2..=255).contains(&shape[0]) && shape[1] == 3 =>
            {
                palette(rgb.as_chunks().0)
            }
            (Some(other), _) => return Err(unfit(other, "u8 [K, 3] with 2 to 255 classes")),
            (None, Some(network)) => Palette::of(network.classes),
            (None, None) => {
                let message = "no array \"colours\", expected u8 [K, 3], or --network to say whose result this is";
                return Err(Error::format(message));
            }
        };
        if let Some(network) = network.filter(|n| n.bounds != bounds || n.classes != palette.classes().len()) {
            let message = format!(
                "bounds {bounds:?} and {} classes, those of --network are {:?} and {}",
                palette.classes().len(),
                network.bounds,
                network.classes
            );
            return Err(Error::mismatch(message));
        }
        Ok(Self { classes, support, confidence, grid: Grid::new(size, bounds), palette })
    }

    fn occupancy(&self) -> Result<Occupancy<'_>> {
        let mut occupancy = Occupancy::new("", &self.classes, self.grid, self.grid.forward())?;
        if !self.support.is_empty() {
            occupancy = occupancy.with_support(&self.support)?;
        }
        if !self.confidence.is_empty() {
            occupancy = occupancy.with_confidence(&self.confidence)?;
        }
        Ok(occupancy)
    }
}

/// Classes of these colours; the names are those of the palette that has as many classes.
fn palette(colours: &[[u8; 3]]) -> Palette {
    let named = Palette::of(colours.len());
    let classes = named.classes().iter().zip(colours);
    Palette::new(classes.map(|(class, &rgb)| Class { name: class.name.clone(), rgb }).collect())
}

fn unfit(array: &OwnedArray, expected: &str) -> Error {
    let kind = array.elements.kind();
    Error::format(format!("array {:?} is {kind} {:?}, expected {expected}", array.name, array.shape))
}
