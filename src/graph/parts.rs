//! Stored parts: what an operation keeps in a model, with names, sizes and precisions.
//!
//! Each operation's description lists its own. Writer ([`crate::model::import`]) and reader ([`crate::model`]) both follow
//! that list, so they cannot disagree.

use super::element::Element;

/// How large weights are stored, and in what is computed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Precision {
    /// Single precision.
    F32,
    /// Half precision: half the file, half the memory, exact widening. Arithmetic is f32.
    F16,
    /// Signed bytes, summed exactly in integers. Operations that stay in floating point store single precision.
    I8,
}

impl Precision {
    /// All of them.
    pub const ALL: [Self; 3] = [Precision::F32, Precision::F16, Precision::I8];

    /// `f32`, `f16` or `int8`.
    pub fn name(self) -> &'static str {
        match self {
            Precision::F32 => "f32",
            Precision::F16 => "f16",
            Precision::I8 => "int8",
        }
    }

    /// The type in which large weights of floating-point operations are stored.
    pub fn element(self) -> Element {
        match self {
            Precision::F32 | Precision::I8 => Element::F32,
            Precision::F16 => Element::F16,
        }
    }

    /// The precision of that name; `i8` is taken for `int8`.
    pub fn parse(name: &str) -> Option<Self> {
        let name = if name == "i8" { "int8" } else { name };
        Self::ALL.into_iter().find(|p| p.name() == name)
    }
}

/// In which type a part is stored.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Storage {
    /// The model's precision: packed panels of the large products.
    Model,
    /// This one, whatever the model's precision.
    Always(Element),
}

/// One stored tensor of an operation.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Part {
    /// What follows the operation's name and a dot.
    pub suffix: &'static str,
    /// Elements, before padding to whole cache lines.
    pub len: usize,
    /// Their type.
    pub storage: Storage,
}

impl Part {
    /// Packed panels in the model's precision.
    pub fn panels(suffix: &'static str, len: usize) -> Self {
        Self { suffix, len, storage: Storage::Model }
    }

    /// Integers, or another type that no model stores otherwise.
    pub fn of(element: Element, suffix: &'static str, len: usize) -> Self {
        Self { suffix, len, storage: Storage::Always(element) }
    }

    /// f32 in every model.
    pub fn plain(suffix: &'static str, len: usize) -> Self {
        Self { suffix, len, storage: Storage::Always(Element::F32) }
    }

    /// Type of its elements in a model of this precision.
    pub fn element(&self, precision: Precision) -> Element {
        match self.storage {
            Storage::Model => precision.element(),
            Storage::Always(element) => element,
        }
    }

    /// Elements stored: `len` and zeros up to a multiple of 64 bytes.
    pub fn stored_len(&self, precision: Precision) -> usize {
        self.len.next_multiple_of(64 / self.element(precision).bytes())
    }
}

/// No operation has more parts.
pub const MAX_PARTS: usize = 15;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn precisions_have_names() {
        for precision in Precision::ALL {
            assert_eq!(Precision::parse(precision.name()), Some(precision));
        }
        assert_eq!(Precision::parse("i8"), Some(Precision::I8));
        assert_eq!(Precision::parse("F32"), None);
    }

    #[test]
    fn parts_fill_whole_cache_lines() {
        let stored = |part: &Part| [Precision::F32, Precision::F16].map(|p| (part.element(p), part.stored_len(p)));
        assert_eq!(stored(&Part::plain("bias", 17)), [(Element::F32, 32); 2]);
        assert_eq!(stored(&Part::panels("weight", 17)), [(Element::F32, 32), (Element::F16, 32)]);
        let scales = Part::of(Element::I8, "scale", 17);
        assert_eq!(stored(&scales), [(Element::I8, 64); 2]);
        assert_eq!(Part::panels("weight", 64).stored_len(Precision::F16), 64);
    }
}
