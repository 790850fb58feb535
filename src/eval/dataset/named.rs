//! Data sets by name, as on the command line.

use super::nuscenes::{Labels, Scenes};
use super::semantickitti::Split;
use super::{DataSet, NuScenes, SemanticKitti, Synthetic};
use crate::base::error::Result;
use std::fmt;
use std::path::PathBuf;
use std::str::FromStr;

/// How sets are named, for help texts.
pub const FORMS: &str = "\
Data sets:
  synthetic:DIR                       what synth --set wrote
  surroundocc:ROOT:LABELS[:SCENES]    nuScenes with the labels of SurroundOcc, LABELS/samples/*.pcd.bin.npy
  occ3d:ROOT:LABELS[:SCENES]          nuScenes with the labels of Occ3D, LABELS/<scene>/<sample>/labels.npz (\"gts\")
  semantickitti:ROOT[:SPLIT[:stereo]] scene completion of SemanticKITTI, ROOT/sequences/NN

ROOT of nuScenes has samples/ and one v1.0-* of tables; of several, name the one, such as ROOT/v1.0-mini.
SCENES: val (the official 150), train (all others), or a file with a name such as scene-0103 a line; all by default.
SPLIT: val (08, the default), train, test, or a sequence such as 05. stereo adds image_3 as a second camera.";

const EXPECTED: &str = "expected synthetic:DIR, surroundocc:ROOT:LABELS[:SCENES], occ3d:ROOT:LABELS[:SCENES] or \
                        semantickitti:ROOT[:SPLIT[:stereo]]";

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
    SemanticKitti { root: PathBuf, split: Split, stereo: bool },
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
            ("semantickitti", [root]) => kitti(root, Split::Val, false),
            ("semantickitti", [root, split]) => kitti(root, split.parse()?, false),
            ("semantickitti", [root, split, "stereo"]) => kitti(root, split.parse()?, true),
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

fn kitti(root: &str, split: Split, stereo: bool) -> Kind {
    Kind::SemanticKitti { root: root.into(), split, stereo }
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
            Kind::SemanticKitti { root, split, stereo } => Box::new(SemanticKitti::open(root, *split, *stereo)?),
        })
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
            ("semantickitti:k", (Split::Val, false)),
            ("semantickitti:k:train", (Split::Train, false)),
            ("semantickitti:k:05:stereo", (Split::Sequence(5), true)),
        ] {
            let Kind::SemanticKitti { split, stereo, .. } = kind(text) else { panic!("SemanticKITTI") };
            assert_eq!((split, stereo), expected, "{text}");
            assert_eq!(text.parse::<Named>().expect(text).to_string(), text);
        }
    }

    #[test]
    fn what_names_no_set_is_refused() {
        for text in ["", "dir", "cifar:x", "surroundocc:n", "occ3d:n:g:val:x", "semantickitti:k:val:mono"] {
            assert_eq!(text.parse::<Named>().expect_err(text), EXPECTED);
        }
        assert!("semantickitti:k:23".parse::<Named>().expect_err("23").contains("a sequence 00 to 21"));
    }
}
