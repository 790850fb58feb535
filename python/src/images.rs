//! Camera images as Python holds them: NumPy arrays of any strides.

use crate::error::Outcome;
use crate::scene::Scene;
use numpy::ndarray::{ArrayView3, Axis};
use numpy::{PyReadonlyArray3, PyReadonlyArray4, PyUntypedArray, PyUntypedArrayMethods};
use pyo3::exceptions::{PyTypeError, PyValueError};
use pyo3::prelude::*;
use std::borrow::Cow;
use voxcast::image::ChannelOrder;
use voxcast::session::views;
use voxcast::{Error, ImageView};

/// The order that `name` says.
fn channel_order(name: Option<&str>) -> PyResult<ChannelOrder> {
    match name {
        Some("bgr") => Ok(ChannelOrder::Bgr),
        Some("rgb") => Ok(ChannelOrder::Rgb),
        Some(other) => Err(PyValueError::new_err(format!("order: found {other:?}, expected \"bgr\" or \"rgb\""))),
        None => {
            Err(PyTypeError::new_err("arrays do not say which colour comes first: give order=\"bgr\" or order=\"rgb\""))
        }
    }
}

/// Calls `f` with the images of all cameras: a scene, u8 [N, H, W, 3], or a sequence of u8 [H, W, 3].
pub(crate) fn with_images<R>(
    images: &Bound<'_, PyAny>,
    order: Option<&str>,
    f: impl FnOnce(&[ImageView<'_>]) -> voxcast::Result<R>,
) -> Outcome<R> {
    if let Ok(scene) = images.cast::<Scene>() {
        if order.is_some() {
            return Err(PyTypeError::new_err("order is for arrays; a scene knows its own").into());
        }
        return Ok(f(&views(&scene.get().scene))?);
    }
    let order = channel_order(order)?;
    if images.cast::<PyUntypedArray>().is_ok() {
        let expected = "uint8 [cameras, height, width, 3]";
        let array: PyReadonlyArray4<'_, u8> = images.extract().map_err(|_| unfit("images", images, expected))?;
        let cameras: Vec<ArrayView3<'_, u8>> = array.as_array().into_outer_iter().collect();
        return with_cameras(&cameras, order, 0, f);
    }
    let mut arrays: Vec<PyReadonlyArray3<'_, u8>> = Vec::new();
    for (camera, image) in images.try_iter()?.enumerate() {
        let image = image?;
        arrays
            .push(image.extract().map_err(|_| unfit(&format!("image {camera}"), &image, "uint8 [height, width, 3]"))?);
    }
    let cameras: Vec<ArrayView3<'_, u8>> = arrays.iter().map(|array| array.as_array()).collect();
    with_cameras(&cameras, order, 0, f)
}

/// Calls `f` with the image of camera `camera`: u8 [H, W, 3].
pub(crate) fn with_image<R>(
    camera: usize,
    image: &Bound<'_, PyAny>,
    order: Option<&str>,
    f: impl FnOnce(ImageView<'_>) -> voxcast::Result<R>,
) -> Outcome<R> {
    let order = channel_order(order)?;
    let unfit = |_| unfit(&format!("image {camera}"), image, "uint8 [height, width, 3]");
    let array: PyReadonlyArray3<'_, u8> = image.extract().map_err(unfit)?;
    with_cameras(&[array.as_array()], order, camera, |views| f(views[0]))
}

fn with_cameras<R>(
    cameras: &[ArrayView3<'_, u8>],
    order: ChannelOrder,
    first: usize,
    f: impl FnOnce(&[ImageView<'_>]) -> voxcast::Result<R>,
) -> Outcome<R> {
    let mut dense = Vec::with_capacity(cameras.len());
    for (camera, image) in (first..).zip(cameras) {
        if image.dim().2 != 3 {
            let message = format!("image {camera}: shape {:?}, expected [height, width, 3]", image.shape());
            return Err(Error::mismatch(message).into());
        }
        dense.push(pixels(image));
    }
    let views: Vec<ImageView<'_>> = cameras
        .iter()
        .zip(&dense)
        .map(|(image, pixels)| {
            let (height, width, _) = image.dim();
            ImageView { height, width, stride: 3 * width, order, pixels }
        })
        .collect();
    Ok(f(&views)?)
}

/// The bytes of an image, row by row: in place where they lie like that, copied otherwise.
pub(crate) fn pixels<'a>(image: &'a ArrayView3<'_, u8>) -> Cow<'a, [u8]> {
    if let Some(pixels) = image.as_slice() {
        return Cow::Borrowed(pixels);
    }
    let mut pixels = Vec::with_capacity(image.len());
    for row in image.axis_iter(Axis(0)) {
        match row.as_slice() {
            Some(row) => pixels.extend_from_slice(row),
            None => pixels.extend(row.iter()),
        }
    }
    Cow::Owned(pixels)
}

/// The error of an argument that is not what it should be.
pub(crate) fn unfit(name: &str, found: &Bound<'_, PyAny>, expected: &str) -> PyErr {
    let described = match found.cast::<PyUntypedArray>() {
        Ok(array) => format!("{} {:?}", array.dtype(), array.shape()),
        Err(_) => found.get_type().to_string(),
    };
    PyTypeError::new_err(format!("{name}: found {described}, expected {expected}"))
}
