//! Data sets by name, as on the command line.

use super::nuscenes::{Labels, Scenes};
use super::semantickitti::{Scans, Split};
use super::{DataSet, NuScenes, Occ3dWaymo, SemanticKitti, SscBench, Synthetic, UniOcc, occ3d_waymo, sscbench};
use crate::base::error::{Error, Result};
use std::fmt;
use std::path::PathBuf;
use std::str::FromStr;

/// How sets are named, for help texts.
pub const FORMS: &str = "\
Data sets:
  synthetic:DIR                       what synth --set wrote
  surroundocc:ROOT:LABELS[:SCENES]    nuScenes with the labels of SurroundOcc, LABELS/samples/*.pcd.bin.npy
  occ3d:ROOT:LABELS[:SCENES]          nuScenes with the labels of Occ3D, LABELS/<scene>/<sample>/labels.npz (\"gts\")
  openocc:ROOT:LABELS[:SCENES]        nuScenes with the labels of OpenOcc v2, LABELS/<scene>/<sample>/labels.npz (\"openocc_v2\")
  occ3d-waymo:ROOT:LABELS:SPLIT       Waymo in the KITTI format of mmdetection3d, LABELS/NNN/FFF_04.npz of Occ3D
  sscbench:ROOT[:SPLIT]               KITTI-360 of SSCBench, ROOT/{preprocess/labels,data_2d_raw,calibration}
  semantickitti:ROOT[:SPLIT[:stereo][:all]]
                                      scene completion of SemanticKITTI, ROOT/sequences/NN
  uniocc:ROOT[:IMAGES]                UniOcc, ROOT/scene_infos.pkl and the frames that it lists, with its calibrations

ROOT of nuScenes has samples/ and one v1.0-* of tables; of several, name the one, such as ROOT/v1.0-mini.
SCENES: val (the official 150), train (all others), or a file with a name such as scene-0103 a line; all by default.
IMAGES of UniOcc: the data set that the frames come from, such as nuScenes; ROOT by default.
SPLIT of Waymo: training or validation; of KITTI-360: val (the default), train or test.
SPLIT of SemanticKITTI: val (08, the default), train, test, or a sequence such as 05. stereo adds image_3 as a second camera.
Scored is every fifth scan, as in the benchmark; all scores every scan that has labels.";

const EXPECTED: &str = "expected synthetic:DIR, surroundocc:ROOT:LABELS[:SCENES], occ3d:ROOT:LABELS[:SCENES], \
                        openocc:ROOT:LABELS[:SCENES], occ3d-waymo:ROOT:LABELS:SPLIT, sscbench:ROOT[:SPLIT], \
                        semantickitti:ROOT[:SPLIT[:stereo][:all]] or uniocc:ROOT[:IMAGES]";

/// A data set by its name, not yet opened. [`FORMS`] has the names.
#[derive(Clone, Debug)]
pub struct Named {
    /// As it was named.
    text: String,
    kind: Kind,
}

#[derive(Clone, Debug)]
enum Kind {
    Synthetic(PathBuf),
    NuScenes { root: PathBuf, labels: Labels, directory: PathBuf, scenes: Scenes },
    Occ3dWaymo { root: PathBuf, labels: PathBuf, split: occ3d_waymo::Split },
    SscBench { root: PathBuf, split: sscbench::Split },
    SemanticKitti { root: PathBuf, split: Split, stereo: bool, scans: Scans },
    UniOcc { root: PathBuf, images: PathBuf },
}

impl FromStr for Named {
    type Err = String;

    fn from_str(text: &str) -> std::result::Result<Self, String> {
        let (name, rest) = text.split_once(':').ok_or(EXPECTED)?;
        let parts: Vec<&str> = rest.split(':').collect();
        let kind = match (name, &parts[..]) {
            ("synthetic", _) => Kind::Synthetic(rest.into()),
            ("surroundocc", [root, directory, scenes @ ..]) if scenes.len() < 2 => {
                nuscenes(root, Labels::SurroundOcc, directory, scenes)
            }
            ("occ3d", [root, directory, scenes @ ..]) if scenes.len() < 2 => {
                nuscenes(root, Labels::Occ3d, directory, scenes)
            }
            ("openocc", [root, directory, scenes @ ..]) if scenes.len() < 2 => {
                nuscenes(root, Labels::OpenOcc, directory, scenes)
            }
            ("occ3d-waymo", [root, labels, split]) => {
                Kind::Occ3dWaymo { root: root.into(), labels: labels.into(), split: split.parse()? }
            }
            ("sscbench", [root]) => Kind::SscBench { root: root.into(), split: sscbench::Split::Val },
            ("sscbench", [root, split]) => Kind::SscBench { root: root.into(), split: split.parse()? },
            ("semantickitti", [root]) => kitti(root, Split::Val, false, Scans::Benchmark),
            ("semantickitti", [root, split]) => kitti(root, split.parse()?, false, Scans::Benchmark),
            ("semantickitti", [root, split, "stereo"]) => kitti(root, split.parse()?, true, Scans::Benchmark),
            ("semantickitti", [root, split, "all"]) => kitti(root, split.parse()?, false, Scans::Labelled),
            ("semantickitti", [root, split, "stereo", "all"]) => kitti(root, split.parse()?, true, Scans::Labelled),
            ("uniocc", [root]) => Kind::UniOcc { root: root.into(), images: root.into() },
            ("uniocc", [root, images]) => Kind::UniOcc { root: root.into(), images: images.into() },
            _ => return Err(EXPECTED.to_owned()),
        };
        Ok(Self { text: text.to_owned(), kind })
    }
}

fn nuscenes(root: &str, labels: Labels, directory: &str, scenes: &[&str]) -> Kind {
    let scenes = match scenes.first() {
        None => Scenes::All,
        Some(&"val") => Scenes::Val,
        Some(&"train") => Scenes::Train,
        Some(&file) => Scenes::Listed(file.into()),
    };
    Kind::NuScenes { root: root.into(), labels, directory: directory.into(), scenes }
}

fn kitti(root: &str, split: Split, stereo: bool, scans: Scans) -> Kind {
    Kind::SemanticKitti { root: root.into(), split, stereo, scans }
}

impl fmt::Display for Named {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.text)
    }
}

impl Named {
    /// Opens the set.
    ///
    /// # Errors
    /// Those of the set, naming the file that is missing or malformed.
    pub fn open(&self) -> Result<Box<dyn DataSet>> {
        Ok(match &self.kind {
            Kind::Synthetic(directory) => Box::new(Synthetic::open(directory)?),
            Kind::NuScenes { root, labels, directory, scenes } => {
                Box::new(NuScenes::open(root, *labels, directory, scenes)?)
            }
            Kind::Occ3dWaymo { root, labels, split } => Box::new(Occ3dWaymo::open(root, labels, *split)?),
            Kind::SscBench { root, split } => Box::new(SscBench::open(root, *split)?),
            Kind::SemanticKitti { root, split, stereo, scans } => {
                Box::new(SemanticKitti::open(root, *split, *stereo, *scans)?)
            }
            Kind::UniOcc { root, images } => Box::new(UniOcc::open(root, images)?),
        })
    }
}

impl Named {
    /// Opens a set of OpenOcc's, as [`write_submission`](crate::eval::write_submission) takes it.
    ///
    /// # Errors
    /// [`ErrorKind::Mismatch`](crate::ErrorKind::Mismatch) for another set; those of [`NuScenes::open`].
    pub fn open_openocc(&self) -> Result<NuScenes> {
        match &self.kind {
            Kind::NuScenes { root, labels: Labels::OpenOcc, directory, scenes } => {
                NuScenes::open(root, Labels::OpenOcc, directory, scenes)
            }
            _ => Err(Error::mismatch(format!("{self}, expected openocc:ROOT:LABELS[:SCENES]"))),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::path::Path;

    fn kind(text: &str) -> Kind {
        text.parse::<Named>().expect(text).kind
    }

    #[test]
    fn sets_by_name() {
        assert!(matches!(kind("synthetic:a:b"), Kind::Synthetic(d) if d == Path::new("a:b")));
        let Kind::NuScenes { root, labels, directory, scenes } = kind("surroundocc:/n:/l") else { panic!("nuScenes") };
        assert_eq!((root, directory), (PathBuf::from("/n"), PathBuf::from("/l")));
        assert_eq!((labels, scenes), (Labels::SurroundOcc, Scenes::All));
        for (text, expected) in
            [("val", Scenes::Val), ("train", Scenes::Train), ("my.txt", Scenes::Listed("my.txt".into()))]
        {
            let Kind::NuScenes { labels, scenes, .. } = kind(&format!("occ3d:n:g:{text}")) else { panic!("nuScenes") };
            assert_eq!((labels, scenes), (Labels::Occ3d, expected));
        }
        for (text, expected) in [
            ("semantickitti:k", (Split::Val, false, Scans::Benchmark)),
            ("semantickitti:k:train", (Split::Train, false, Scans::Benchmark)),
            ("semantickitti:k:val:all", (Split::Val, false, Scans::Labelled)),
            ("semantickitti:k:05:stereo", (Split::Sequence(5), true, Scans::Benchmark)),
            ("semantickitti:k:05:stereo:all", (Split::Sequence(5), true, Scans::Labelled)),
        ] {
            let Kind::SemanticKitti { split, stereo, scans, .. } = kind(text) else { panic!("SemanticKITTI") };
            assert_eq!((split, stereo, scans), expected, "{text}");
            assert_eq!(text.parse::<Named>().expect(text).to_string(), text);
        }
    }

    #[test]
    fn further_sets_by_name() {
        let Kind::NuScenes { labels, scenes, .. } = kind("openocc:n:g:val") else { panic!("nuScenes") };
        assert_eq!((labels, scenes), (Labels::OpenOcc, Scenes::Val));
        let Kind::Occ3dWaymo { labels, split, .. } = kind("occ3d-waymo:k:voxel04:validation") else { panic!("Waymo") };
        assert_eq!((labels, split), (PathBuf::from("voxel04"), occ3d_waymo::Split::Validation));
        for (text, expected) in [("sscbench:k", sscbench::Split::Val), ("sscbench:k:test", sscbench::Split::Test)] {
            assert!(matches!(kind(text), Kind::SscBench { split, .. } if split == expected), "{text}");
        }
    }

    #[test]
    fn uniocc_has_its_images_beside_it_or_elsewhere() {
        for (text, expected) in [("uniocc:mini", ["mini", "mini"]), ("uniocc:mini:nuscenes", ["mini", "nuscenes"])] {
            let Kind::UniOcc { root, images } = kind(text) else { panic!("UniOcc") };
            assert_eq!([root, images], expected.map(PathBuf::from), "{text}");
        }
    }

    #[test]
    fn what_names_no_set_is_refused() {
        for text in [
            "",
            "dir",
            "cifar:x",
            "surroundocc:n",
            "occ3d:n:g:val:x",
            "semantickitti:k:val:mono",
            "semantickitti:k:val:all:stereo",
            "occ3d-waymo:k:l",
            "uniocc:mini:nuscenes:val",
        ] {
            assert_eq!(text.parse::<Named>().expect_err(text), EXPECTED);
        }
        assert!("sscbench:k:08".parse::<Named>().expect_err("08").contains("train, val or test"));
        assert!("occ3d-waymo:k:l:val".parse::<Named>().expect_err("val").contains("training or validation"));
        assert!("semantickitti:k:23".parse::<Named>().expect_err("23").contains("a sequence 00 to 21"));
    }
}
