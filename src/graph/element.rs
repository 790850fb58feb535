//! What tensors and stored parts are made of: types of elements, and bytes that know theirs.

use bytemuck::Pod;
use half::f16;
use safetensors::Dtype;
use voxcast_kernels::Panels;

/// The type of an element.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Element {
    /// Single precision.
    F32,
    /// Half precision. Storage only: arithmetic widens it.
    F16,
    /// Unsigned bytes.
    U8,
    /// Signed bytes.
    I8,
    /// Signed 32-bit integers.
    I32,
}

impl Element {
    /// Bytes of one element.
    pub const fn bytes(self) -> usize {
        match self {
            Element::F32 | Element::I32 => 4,
            Element::F16 => 2,
            Element::U8 | Element::I8 => 1,
        }
    }

    /// `f32`, `f16`, `u8`, `i8` or `i32`.
    pub const fn name(self) -> &'static str {
        match self {
            Element::F32 => "f32",
            Element::F16 => "f16",
            Element::U8 => "u8",
            Element::I8 => "i8",
            Element::I32 => "i32",
        }
    }
}

impl From<Element> for Dtype {
    fn from(element: Element) -> Self {
        match element {
            Element::F32 => Dtype::F32,
            Element::F16 => Dtype::F16,
            Element::U8 => Dtype::U8,
            Element::I8 => Dtype::I8,
            Element::I32 => Dtype::I32,
        }
    }
}

/// A Rust type that is an [`Element`].
pub trait Scalar: Pod {
    /// Which one.
    const ELEMENT: Element;
}

impl Scalar for f32 {
    const ELEMENT: Element = Element::F32;
}
impl Scalar for f16 {
    const ELEMENT: Element = Element::F16;
}
impl Scalar for u8 {
    const ELEMENT: Element = Element::U8;
}
impl Scalar for i8 {
    const ELEMENT: Element = Element::I8;
}
impl Scalar for i32 {
    const ELEMENT: Element = Element::I32;
}

/// Bytes that are elements of a known type, aligned for it.
#[derive(Clone, Copy, Debug)]
pub struct Elements<'a> {
    element: Element,
    bytes: &'a [u8],
}

impl<'a> Elements<'a> {
    /// None at all.
    pub const EMPTY: Self = Self { element: Element::U8, bytes: &[] };

    /// `bytes` as elements of type `element`.
    ///
    /// # Panics
    /// If they are not a whole number of elements or not aligned for them.
    pub fn new(element: Element, bytes: &'a [u8]) -> Self {
        let size = element.bytes();
        assert!(bytes.len().is_multiple_of(size), "{} bytes are no whole number of {}", bytes.len(), element.name());
        assert!((bytes.as_ptr() as usize).is_multiple_of(size), "{} that are not aligned", element.name());
        Self { element, bytes }
    }

    /// Their type.
    pub fn element(self) -> Element {
        self.element
    }

    /// Their bytes, in the order of this machine.
    pub fn bytes(self) -> &'a [u8] {
        self.bytes
    }

    /// How many there are.
    pub fn len(self) -> usize {
        self.bytes.len() / self.element.bytes()
    }

    /// Whether there are none.
    pub fn is_empty(self) -> bool {
        self.bytes.is_empty()
    }

    /// The elements, if they are of type `T`.
    pub fn get<T: Scalar>(self) -> Option<&'a [T]> {
        (T::ELEMENT == self.element).then(|| bytemuck::cast_slice(self.bytes))
    }

    /// The elements.
    ///
    /// # Panics
    /// If they are not of type `T`.
    pub fn of<T: Scalar>(self) -> &'a [T] {
        match self.get() {
            Some(elements) => elements,
            None => panic!("elements of type {}, not {}", self.element.name(), T::ELEMENT.name()),
        }
    }

    /// Packed weights of the large products, which are stored in either precision.
    ///
    /// # Panics
    /// If they are integers.
    pub fn panels(self) -> Panels<'a> {
        match self.element {
            Element::F16 => Panels::F16(self.of()),
            _ => Panels::F32(self.of()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bytes_know_what_they_are() {
        let values = [1.0f32, -2.0];
        let elements = Elements::new(Element::F32, bytemuck::cast_slice(&values));
        assert_eq!((elements.len(), elements.of::<f32>(), elements.get::<i32>()), (2, &values[..], None));
        assert!(matches!(elements.panels(), Panels::F32(v) if v == values));
        let half = [f16::ONE; 3];
        let elements = Elements::new(Element::F16, bytemuck::cast_slice(&half));
        assert!(matches!(elements.panels(), Panels::F16(v) if v == half));
        for element in [Element::F32, Element::F16, Element::U8, Element::I8, Element::I32] {
            assert!(Elements::new(element, bytemuck::cast_slice(&values[..0])).is_empty());
        }
        let panics = |f: fn() -> usize| std::panic::catch_unwind(f).is_err();
        assert!(panics(|| Elements::new(Element::F32, &[0; 6]).len()));
        assert!(panics(|| Elements::new(Element::U8, &[0; 6]).of::<i8>().len()));
        assert!(panics(|| Elements::new(Element::I8, &[0; 6]).panels().len()));
        assert!(!panics(|| Elements::new(Element::I8, &[0; 6]).of::<i8>().len()));
    }
}
