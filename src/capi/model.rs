//! Models and what is known of their networks.

use super::options;
use super::pointers::{array, path, write_sized};
use super::status::{Failure, call, free, given, invalid, make};
use super::types::{Network, Options, Status};
use crate::check::selftest;
use crate::model::Model;
use std::ffi::{c_char, c_void};
use std::mem::MaybeUninit;
use std::sync::Arc;

/// `voxcast_model`.
pub(super) struct ModelHandle(pub(super) Arc<Model>);

/// A place for a new model.
type Place<'a> = Option<&'a mut MaybeUninit<Option<Box<ModelHandle>>>>;

/// # Safety
/// The pointers are as `voxcast.h` says.
#[unsafe(no_mangle)]
unsafe extern "C" fn voxcast_model_open(
    file: *const c_char,
    model: Place<'_>,
    message: *mut c_char,
    capacity: usize,
) -> i32 {
    // SAFETY: `file` is null or a string and `message` is null or has room, as the header asks of the caller.
    unsafe { make(model, message, capacity, || Ok(ModelHandle(Arc::new(Model::open(path(file)?)?)))) }
}

/// # Safety
/// The pointers are as `voxcast.h` says.
#[unsafe(no_mangle)]
unsafe extern "C" fn voxcast_model_from_bytes(
    bytes: *const c_void,
    length: usize,
    model: Place<'_>,
    message: *mut c_char,
    capacity: usize,
) -> i32 {
    let body = || {
        if !bytes.cast::<u64>().is_aligned() {
            return Err(invalid("bytes are not aligned to 8"));
        }
        // SAFETY: the header asks the caller to leave the bytes as they are until the model and all that was made of it
        // are freed; nothing refers to them for longer.
        let bytes: &'static [u8] = unsafe { array(bytes.cast(), length, "bytes") }?;
        Ok(ModelHandle(Arc::new(Model::from_bytes(bytes)?)))
    };
    // SAFETY: `message` is null or has room, as the header asks of the caller.
    unsafe { make(model, message, capacity, body) }
}

#[unsafe(no_mangle)]
extern "C" fn voxcast_model_free(model: Option<Box<ModelHandle>>) {
    free(model);
}

/// # Safety
/// The pointers are as `voxcast.h` says.
#[unsafe(no_mangle)]
unsafe extern "C" fn voxcast_model_network(
    model: Option<&ModelHandle>,
    network: *mut Network,
    message: *mut c_char,
    capacity: usize,
) -> i32 {
    let body = || {
        let model = &given(model, "model")?.0;
        let described = model.network();
        let [height, width] = described.image;
        let grid = described.output_grid();
        let value = Network {
            size: size_of::<Network>(),
            cameras: described.cameras,
            classes: described.classes,
            height,
            width,
            grid,
            voxels: grid.iter().product(),
            bounds: described.bounds,
            checksum: model.checksum().unwrap_or(0),
        };
        // SAFETY: `network` is null or a struct of the size that it says, as the header asks of the caller.
        unsafe { write_sized(network, &value, "network") }
    };
    // SAFETY: `message` is null or has room, as the header asks of the caller.
    unsafe { call(message, capacity, body) }
}

/// # Safety
/// The pointers are as `voxcast.h` says.
#[unsafe(no_mangle)]
unsafe extern "C" fn voxcast_model_selftest(
    model: Option<&ModelHandle>,
    options: *const Options,
    message: *mut c_char,
    capacity: usize,
) -> i32 {
    let body = || {
        let model = &given(model, "model")?.0;
        // SAFETY: `options` is null or a struct of the size that it says, as the header asks of the caller.
        let options = unsafe { options::read(options) }?;
        let fault = selftest::run(model, options.isa, &options.threads)?.fault;
        fault.map_or(Ok(()), |fault| Err(Failure::new(Status::SelftestFailed, fault.to_string())))
    };
    // SAFETY: `message` is null or has room, as the header asks of the caller.
    unsafe { call(message, capacity, body) }
}
