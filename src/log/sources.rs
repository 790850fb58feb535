//! Which topics are cameras.

use crate::base::error::{Error, Result};
use crate::scene::camera::NUSCENES_RING;

/// A topic with images or calibrations.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Topic {
    pub(super) name: String,
    /// The frame of reference of its first message.
    pub(super) frame: String,
}

/// A camera of a log.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct CameraTopics {
    pub(super) name: String,
    /// Topic of its images.
    pub(super) images: String,
    /// Topic of its calibration.
    pub(super) calibration: String,
    /// Its frame of reference.
    pub(super) frame: String,
    /// Whether the images are free of distortion already, as ROS's `image_rect` topics are.
    pub(super) rectified: bool,
}

/// Finds the cameras: those of `named` (name and topic of images) in its order, or else every topic with images, in the order
/// of nuScenes if all have its names, otherwise in that of their topics.
///
/// A topic's camera is called after the last part of its name that is not about the image: `/front/image_rect/compressed` is of
/// `front`. If two would be called the same, both keep all parts. The calibration is the topic beside the images
/// (`/front/camera_info`), or else the one of the same frame of reference.
///
/// # Errors
/// [`ErrorKind::Mismatch`](crate::ErrorKind::Mismatch) for other than `expected` cameras, for a camera with two topics of
/// images, and for one whose calibration is not found.
pub(super) fn find(
    images: &[Topic],
    calibrations: &[Topic],
    named: &[(String, String)],
    expected: usize,
) -> Result<Vec<CameraTopics>> {
    let mut chosen: Vec<(String, &Topic)> = match named {
        [] => called(images)?,
        named => named
            .iter()
            .map(|(name, topic)| Ok((name.clone(), topic_of(images, name, topic)?)))
            .collect::<Result<_>>()?,
    };
    if named.is_empty() {
        let place = |name: &str| NUSCENES_RING.iter().position(|known| *known == name);
        if chosen.iter().all(|(name, _)| place(name).is_some()) {
            chosen.sort_by_key(|(name, _)| place(name));
        }
    }
    if chosen.len() != expected {
        let found: Vec<String> = chosen.iter().map(|(name, topic)| format!("{name} ({})", topic.name)).collect();
        let found = if found.is_empty() { "none".to_owned() } else { found.join(", ") };
        let message =
            format!("{} cameras, the model expects {expected}; found {found}; name them with --camera", chosen.len());
        return Err(Error::mismatch(message));
    }
    let camera = |(name, topic): (String, &Topic)| {
        let calibration = calibration_of(topic, calibrations)?;
        let frame = if topic.frame.is_empty() { calibration.frame.clone() } else { topic.frame.clone() };
        let (_, about) = parts(&topic.name);
        let rectified = about.iter().any(|part| part.starts_with("image_rect"));
        Ok(CameraTopics { name, images: topic.name.clone(), calibration: calibration.name.clone(), frame, rectified })
    };
    chosen.into_iter().map(camera).collect()
}

/// The parts of a topic's name that say which camera it is of, and those that say what it holds of it.
fn parts(topic: &str) -> (Vec<&str>, Vec<&str>) {
    let mut parts: Vec<&str> = topic.split('/').filter(|part| !part.is_empty()).collect();
    let is_about = |part: &str| part.starts_with("image") || ["compressed", "raw", "color", "rgb"].contains(&part);
    let mut first = parts.len();
    while first > 1 && is_about(parts[first - 1]) {
        first -= 1;
    }
    let about = parts.split_off(first);
    (parts, about)
}

/// Every topic of images with a name for its camera.
fn called(images: &[Topic]) -> Result<Vec<(String, &Topic)>> {
    let mut all: Vec<(Vec<&str>, &Topic)> = images.iter().map(|topic| (parts(&topic.name).0, topic)).collect();
    all.sort_by(|a, b| a.1.name.cmp(&b.1.name));
    for (i, (whose, topic)) in all.iter().enumerate() {
        if let Some((_, other)) = all[..i].iter().find(|(other, _)| other == whose) {
            let message = format!(
                "{} and {} are images of one camera; name one with --camera NAME=TOPIC",
                other.name, topic.name
            );
            return Err(Error::mismatch(message));
        }
    }
    let last = |whose: &[&str]| whose.last().map_or(String::new(), |part| (*part).to_owned());
    let name = |whose: &Vec<&str>| {
        let short = last(whose);
        if all.iter().filter(|(other, _)| last(other) == short).count() == 1 { short } else { whose.join("/") }
    };
    Ok(all.iter().map(|(whose, topic)| (name(whose), *topic)).collect())
}

fn topic_of<'a>(images: &'a [Topic], name: &str, topic: &str) -> Result<&'a Topic> {
    images.iter().find(|known| known.name == topic).ok_or_else(|| {
        let known: Vec<&str> = images.iter().map(|known| known.name.as_str()).collect();
        let known = if known.is_empty() { "none".to_owned() } else { known.join(", ") };
        Error::mismatch(format!("camera {name}: no images on topic {topic}, expected one of: {known}"))
    })
}

fn calibration_of<'a>(images: &Topic, calibrations: &'a [Topic]) -> Result<&'a Topic> {
    let whose = parts(&images.name).0.len();
    let split = |name: &'a str| name.split('/').filter(|part| !part.is_empty()).collect::<Vec<&str>>();
    let image_parts: Vec<&str> = images.name.split('/').filter(|part| !part.is_empty()).collect();
    // In the camera's own place, or nearer to the images. A topic of one part has no place but the root.
    let beside = |topic: &&'a Topic| {
        let parts = split(&topic.name);
        let place = &parts[..parts.len().saturating_sub(1)];
        image_parts.starts_with(place) && (place.len() >= whose || image_parts.len() == 1)
    };
    let framed = |topic: &&Topic| !images.frame.is_empty() && topic.frame == images.frame;
    for choice in [calibrations.iter().filter(beside).collect::<Vec<_>>(), calibrations.iter().filter(framed).collect()]
    {
        match choice[..] {
            [one] => return Ok(one),
            [] => {}
            [first, second, ..] => {
                let (first, second) = (&first.name, &second.name);
                return Err(Error::mismatch(format!("two calibrations of {}: {first} and {second}", images.name)));
            }
        }
    }
    let known: Vec<&str> = calibrations.iter().map(|topic| topic.name.as_str()).collect();
    let known = if known.is_empty() { "none".to_owned() } else { known.join(", ") };
    let message = format!(
        "no calibration of {}, expected a topic beside it or one of frame {:?}; found {known}",
        images.name, images.frame
    );
    Err(Error::mismatch(message))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn topics(names: &[(&str, &str)]) -> Vec<Topic> {
        names.iter().map(|&(name, frame)| Topic { name: name.to_owned(), frame: frame.to_owned() }).collect()
    }

    fn names(cameras: &[CameraTopics]) -> Vec<&str> {
        cameras.iter().map(|camera| camera.name.as_str()).collect()
    }

    #[test]
    fn topics_by_themselves() {
        let images = topics(&[
            ("/CAM_BACK/image", "b"),
            ("/CAM_FRONT/image_rect_compressed", "f"),
            ("/CAM_FRONT_RIGHT/image_raw/compressed", ""),
        ]);
        let calibrations =
            topics(&[("/CAM_FRONT/camera_info", "f"), ("/else/where", "b"), ("/CAM_FRONT_RIGHT/calibration", "r")]);
        let found = find(&images, &calibrations, &[], 3).expect("cameras");
        assert_eq!(names(&found), ["CAM_FRONT", "CAM_FRONT_RIGHT", "CAM_BACK"], "as nuScenes has them");
        assert_eq!(found[2].calibration, "/else/where", "by its frame");
        assert_eq!((found[1].frame.as_str(), found[1].rectified, found[0].rectified), ("r", false, true));
        let error = find(&images, &calibrations, &[], 6).unwrap_err();
        assert!(
            error.message().contains("3 cameras, the model expects 6; found CAM_FRONT (/CAM_FRONT/image_rect"),
            "{error}"
        );
        let named = [("back".to_owned(), "/CAM_BACK/image".to_owned())];
        assert_eq!(names(&find(&images, &calibrations, &named, 1).expect("a camera")), ["back"]);
        let named = [("back".to_owned(), "/CAM_BACK".to_owned())];
        let error = find(&images, &calibrations, &named, 1).unwrap_err();
        assert!(error.message().contains("camera back: no images on topic /CAM_BACK"), "{error}");
    }

    #[test]
    fn names_that_are_not_alone() {
        let images = topics(&[("/two/color/image_raw", "2"), ("/one/color/image_raw", "1")]);
        let calibrations = topics(&[("/one/color/camera_info", "1"), ("/two/color/camera_info", "1")]);
        let found = find(&images, &calibrations, &[], 2).expect("cameras");
        assert_eq!(names(&found), ["one", "two"], "color says nothing about which camera it is");
        let images = topics(&[("/a/cam/image_raw", "2"), ("/b/cam/image_raw", "1")]);
        let error = find(&images, &calibrations, &[], 2).unwrap_err();
        assert!(
            error.message().contains("two calibrations of /b/cam/image_raw")
                || error.message().contains("no calibration of /a"),
            "{error}"
        );
        let images = topics(&[("/a/image_raw", "2"), ("/a/image_raw/compressed", "1")]);
        let error = find(&images, &calibrations, &[], 1).unwrap_err();
        assert!(error.message().contains("are images of one camera"), "{error}");
        let alone = topics(&[("/image", "x")]);
        let found = find(&alone, &topics(&[("/camera_info", "y")]), &[], 1).expect("a camera");
        assert_eq!((names(&found), found[0].calibration.as_str()), (vec!["image"], "/camera_info"));
    }
}
