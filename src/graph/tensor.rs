//! Tensors: what lies between operations.

use super::element::Element;
use super::scale::Scale;
use std::fmt;

/// A tensor of a [`Graph`](super::Graph), by position in its list.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct TensorId(pub usize);

/// What a tensor's positions are positions of.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Space {
    /// Pixels of one camera: 1, height, width.
    Image,
    /// Cells of the bird's-eye view: 1, x, y.
    Plane,
    /// Voxels: x, y, z.
    Volume,
}

/// Which branch of a level.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Branch {
    /// Pixels to voxels and cells.
    Gather,
    /// The voxels, and their fusion with the plane.
    Volume,
    /// The plane.
    Bev,
}

/// The part of the network that a tensor belongs to, with the operation that writes it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Section {
    /// The backbone's first convolution, and what comes before it.
    Stem,
    /// A stage of the backbone, 1 to 4.
    Stage(usize),
    /// The feature pyramid.
    Pyramid,
    /// A branch of level 1 to 3.
    Level(usize, Branch),
    /// A level, 1 to 3, doubled.
    Upsample(usize),
    /// The refinement of level 0 to 3.
    Refine(usize),
    /// The occupancy heads.
    Head,
}

impl fmt::Display for Section {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Section::Stem => f.write_str("backbone stem"),
            Section::Stage(stage) => write!(f, "backbone layer{stage}"),
            Section::Pyramid => f.write_str("pyramid"),
            Section::Level(level, Branch::Gather) => write!(f, "level {level} gather"),
            Section::Level(level, Branch::Volume) => write!(f, "level {level} volume"),
            Section::Level(level, Branch::Bev) => write!(f, "level {level} bev"),
            Section::Upsample(level) => write!(f, "up_sample{level}"),
            Section::Refine(level) => write!(f, "refine_lvl{level}"),
            Section::Head => f.write_str("head"),
        }
    }
}

/// On which side of the graph a tensor lies.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Scope {
    /// Written by the caller.
    Input,
    /// Between operations.
    Inner,
    /// Read by the caller. Two of it exist: one is written while the other, the last complete one, is read.
    Output,
}

/// How long a tensor is needed, and how many of it there are.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Lifetime {
    /// Within the pass of one camera; all cameras use the same memory, one after the other.
    Pass,
    /// One place per camera, kept from frame to frame.
    Camera,
    /// After all cameras.
    Frame,
}

/// A channels-last tensor.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Tensor {
    /// The operation that writes it (the first, where several fill channels side by side).
    pub name: String,
    /// Type of its elements.
    pub element: Element,
    /// What one step of an `i8` element stands for; none for other types.
    pub scale: Option<Scale>,
    /// What its positions are.
    pub space: Space,
    /// The part of the network that it belongs to.
    pub section: Section,
    /// On which side of the graph it lies.
    pub scope: Scope,
    /// How long it lives.
    pub lifetime: Lifetime,
    /// x, y, z of a volume; 1, height, width of an image; 1, x, y of a bird's-eye view.
    pub extent: [usize; 3],
    /// Elements per position.
    pub channels: usize,
}

impl Tensor {
    /// Positions.
    pub fn rows(&self) -> usize {
        self.extent.iter().product()
    }

    /// Elements, of one camera where there are several.
    pub fn len(&self) -> usize {
        self.rows() * self.channels
    }

    /// Whether it holds nothing.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Bytes of one position.
    pub fn row_bytes(&self) -> usize {
        self.channels * self.element.bytes()
    }

    /// Bytes, of one camera where there are several.
    pub fn bytes(&self) -> usize {
        self.rows() * self.row_bytes()
    }

    /// How many of it there are with so many cameras.
    pub fn copies(&self, cameras: usize) -> usize {
        match self.lifetime {
            Lifetime::Camera => cameras,
            Lifetime::Pass | Lifetime::Frame => 1,
        }
    }
}
