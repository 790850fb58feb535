//! When a scene's images were taken.

use crate::base::error::{Error, Result};
use serde_json::Value;

/// The `stamp` of each camera of a `calibration.json`, in its order: nanoseconds since 1970 or since a drive began. None if no
/// camera has one.
///
/// # Errors
/// [`ErrorKind::Format`](crate::ErrorKind::Format) if the text is not JSON, a stamp is no whole number from 0 on, or some
/// cameras have one and others have not.
pub fn read_stamps(text: &str) -> Result<Option<Vec<u64>>> {
    let root: Value = serde_json::from_str(text).map_err(|e| Error::format(format!("calibration JSON: {e}")))?;
    let cameras = root.get("cameras").and_then(Value::as_array).map_or(&[][..], Vec::as_slice);
    let mut stamps = Vec::new();
    for (index, camera) in cameras.iter().enumerate() {
        let Some(stamp) = camera.get("stamp") else { continue };
        stamps.push(stamp.as_u64().ok_or_else(|| {
            Error::format(format!("camera {index}: \"stamp\" is {stamp}, expected nanoseconds as a whole number"))
        })?);
    }
    match stamps.len() {
        0 => Ok(None),
        n if n == cameras.len() => Ok(Some(stamps)),
        n => Err(Error::format(format!("{n} of {} cameras have a \"stamp\", expected all or none", cameras.len()))),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn all_or_none() {
        let read = |text: &str| read_stamps(text);
        assert_eq!(
            read(r#"{"cameras": [{"stamp": 5}, {"stamp": 18446744073709551615}]}"#).unwrap(),
            Some(vec![5, u64::MAX])
        );
        assert_eq!(read(r#"{"cameras": [{}]}"#).unwrap(), None);
        for (text, expected) in [
            (r#"{"cameras": [{"stamp": 5}, {}]}"#, "1 of 2 cameras"),
            (r#"{"cameras": [{"stamp": -5}]}"#, "camera 0: \"stamp\" is -5"),
            (r#"{"cameras": [{"stamp": 1.5}]}"#, "is 1.5"),
            ("{", "calibration JSON"),
        ] {
            assert!(read(text).unwrap_err().message().contains(expected), "{text}");
        }
    }
}
