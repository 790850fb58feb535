use super::*;
use crate::base::error::ErrorKind;
use crate::network::Grid;
use crate::show::picture::Class;
use flate2::read::{GzDecoder, ZlibDecoder};
use serde_json::Value;
use std::io::Read;

const GRID: [usize; 3] = [4, 5, 3];
const BOUNDS: [[f32; 2]; 3] = [[-2.0, 2.0], [-2.5, 2.5], [-1.0, 2.0]];

/// Ends an element, begins others, and names a place of the template.
const HOSTILE: &str = "</script><script>alert(1)</script><!--<img src=x onerror='alert(2)'>\"&amp;{{STYLE}}\u{2028}";

fn classes() -> Vec<u8> {
    (0..60).map(|i| (i * i % 7 % 5) as u8).collect()
}

fn support() -> Vec<u16> {
    (0..60).map(|i| i * 700 % 1900).collect()
}

fn scene() -> Scene {
    let image = |width, height, bgr: [u8; 3]| Image { height, width, bgr: bgr.repeat(width * height) };
    let matrix = |f: f32| [f, 0., 8., 0., 0., f, 4., 0., 0., 0., 1., 0.5, 0., 0., 0., 1.];
    Scene {
        names: vec!["CAM_FRONT".into(), HOSTILE.into()],
        images: vec![image(1300, 500, [0, 0, 255]), image(64, 33, [200, 0, 0])],
        lidar2img: vec![matrix(12.5), matrix(40.0)],
    }
}

/// The page of everything above.
fn page(truth: Option<&[u8]>, scene: Option<&Scene>, title: &str, palette: &Palette) -> Result<String> {
    let (classes, support) = (classes(), support());
    let prediction = Occupancy::new("", &classes, Grid::new(GRID, BOUNDS), [0.0, 1.0])?.with_support(&support)?;
    Page { title, subtitle: "of a test", prediction, truth, scene, palette }.to_html()
}

#[test]
fn confidence_travels_where_there_is_one() {
    let (classes, palette) = (classes(), Palette::of(5));
    let codes: Vec<u8> = (0..60).map(|i| 4 * i).collect();
    let prediction = Occupancy::new("", &classes, Grid::new(GRID, BOUNDS), [0.0, 1.0]).unwrap();
    let page = |prediction| Page { title: "", subtitle: "", prediction, truth: None, scene: None, palette: &palette };
    let with = page(prediction.with_confidence(&codes).unwrap()).to_html().unwrap();
    assert_eq!(inflated(&data(&with)["confidence"]), codes);
    assert!(data(&page(prediction).to_html().unwrap())["confidence"].is_null());
    assert_eq!(prediction.with_confidence(&codes[1..]).unwrap_err().kind(), ErrorKind::Mismatch);
}

fn data(html: &str) -> Value {
    let (_, json) = html.split_once("<script type=\"application/json\" id=\"data\">").unwrap();
    serde_json::from_str(json.split_once("</script>").unwrap().0).unwrap()
}

fn decoded(text: &str) -> Vec<u8> {
    let digit = |c: u8| match c {
        b'A'..=b'Z' => c - b'A',
        b'a'..=b'z' => c - b'a' + 26,
        b'0'..=b'9' => c - b'0' + 52,
        b'+' => 62,
        b'/' => 63,
        other => panic!("{other} is no digit of base64"),
    };
    let four = |digits: &[u8]| {
        let bits = digits.iter().fold(0u32, |bits, &c| bits << 6 | u32::from(digit(c))) << (24 - 6 * digits.len());
        bits.to_be_bytes()[1..digits.len()].to_vec()
    };
    text.trim_end_matches('=').as_bytes().chunks(4).flat_map(four).collect()
}

fn inflated(value: &Value) -> Vec<u8> {
    let mut bytes = Vec::new();
    ZlibDecoder::new(&decoded(value.as_str().unwrap())[..]).read_to_end(&mut bytes).unwrap();
    bytes
}

#[test]
fn base64_by_its_standard() {
    for (bytes, text) in
        [("", ""), ("f", "Zg=="), ("fo", "Zm8="), ("foo", "Zm9v"), ("foob", "Zm9vYg=="), ("foobar", "Zm9vYmFy")]
    {
        assert_eq!((base64(bytes.as_bytes()).as_str(), decoded(text)), (text, bytes.as_bytes().to_vec()));
    }
    assert_eq!(base64(&[0xfb, 0xef, 0xff]), "++//");
    let all: Vec<u8> = (0..=255).collect();
    assert_eq!(decoded(&base64(&all)), all);
}

#[test]
fn the_page_holds_what_it_was_given() {
    let truth: Vec<u8> = classes().iter().rev().map(|&c| if c == 3 { 255 } else { c }).collect();
    let scene = scene();
    let html = page(Some(&truth), Some(&scene), "out.npz", &Palette::of(17)).unwrap();
    let data = data(&html);
    assert!(inflated(&data["prediction"]["classes"]) == classes());
    assert!(inflated(&data["truth"]["classes"]) == truth);
    let counts: Vec<u16> = inflated(&data["support"]).as_chunks().0.iter().map(|&b| u16::from_le_bytes(b)).collect();
    assert!(counts == support());
    assert_eq!(data["grid"], serde_json::json!(GRID));
    assert_eq!(data["bounds"], serde_json::json!(BOUNDS));
    assert_eq!(data["forward"], serde_json::json!([0.0, 1.0]));
    assert_eq!(data["digest"], format!("{:016x}", xxhash_rust::xxh3::xxh3_64(&classes())));
    assert_eq!(data["classes"][4], serde_json::json!({ "name": "car", "rgb": [0, 150, 245] }));
    assert_eq!((data["prediction"]["caption"].as_str(), data["title"].as_str()), (Some("prediction"), Some("out.npz")));
    let cameras = data["cameras"].as_array().unwrap();
    assert_eq!(cameras.len(), 2);
    assert_eq!((&cameras[0]["width"], &cameras[0]["height"]), (&serde_json::json!(1300), &serde_json::json!(500)));
    assert_eq!(cameras[1]["lidar2img"], serde_json::json!(scene.lidar2img[1]));
    assert!(html.starts_with("<!doctype html>") && html.contains("<title>out.npz</title>"));
}

#[test]
fn what_is_not_given_is_not_there() {
    let classes = classes();
    let prediction = Occupancy::new("", &classes, Grid::new(GRID, BOUNDS), [0.0, 1.0]).unwrap();
    let palette = Palette::of(5);
    let html = Page { title: "", subtitle: "", prediction, truth: None, scene: None, palette: &palette };
    let data = data(&html.to_html().unwrap());
    assert_eq!(
        (&data["truth"], &data["support"], &data["cameras"]),
        (&Value::Null, &Value::Null, &serde_json::json!([]))
    );
}

#[test]
fn images_are_small_and_keep_their_colours() {
    let html = page(None, Some(&scene()), "", &Palette::of(17)).unwrap();
    let data = data(&html);
    for (camera, size, rgb) in [(0, (640, 247), [254, 0, 0]), (1, (64, 33), [0, 0, 200])] {
        let uri = data["cameras"][camera]["image"].as_str().unwrap();
        let jpeg = decoded(uri.strip_prefix("data:image/jpeg;base64,").unwrap());
        let image = image::load_from_memory_with_format(&jpeg, image::ImageFormat::Jpeg).unwrap().into_rgb8();
        assert_eq!(image.dimensions(), size);
        let near = |p: &Rgb<u8>| p.0.iter().zip(rgb).all(|(&a, b)| a.abs_diff(b) <= 4);
        assert!(image.pixels().all(near), "{:?}", image.get_pixel(3, 3));
    }
}

#[test]
fn hostile_names_stay_text() {
    let palette = Palette::new((0..6).map(|k| Class { name: format!("{HOSTILE}{k}"), rgb: [k; 3] }).collect());
    let plain = page(None, None, "plain", &Palette::of(6)).unwrap();
    let html = page(None, Some(&scene()), HOSTILE, &palette).unwrap();
    for tag in ["<script", "</script", "<!--", "<img", "<style", "</title"] {
        assert_eq!(html.matches(tag).count(), plain.matches(tag).count(), "{tag}");
    }
    assert_eq!(html.matches(STYLE).count(), 1, "names are not taken for places of the template");
    let data = data(&html);
    assert_eq!(data["title"], HOSTILE);
    assert_eq!(data["classes"][5]["name"], format!("{HOSTILE}5"));
    assert_eq!(data["cameras"][1]["name"], HOSTILE);
}

/// The policy would stop a request; there must be none to stop.
#[test]
fn nothing_is_asked_of_a_network() {
    // Hostile names hold what would be requests, were they not text.
    let plain = Scene { names: vec!["CAM_FRONT".into(), "CAM_BACK".into()], ..scene() };
    let html = page(None, Some(&plain), "out.npz", &Palette::of(17)).unwrap();
    let policy = "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data:; \
                  base-uri 'none'; form-action 'none'";
    assert!(html.contains(&format!("<meta http-equiv=\"Content-Security-Policy\" content=\"{policy}\">")));
    let mut three = String::new();
    GzDecoder::new(THREE).read_to_string(&mut three).unwrap();
    assert!(three.starts_with("var THREE=(") && three.contains("\"187\""), "{}", &three[..40]);
    for (what, text) in [("page", &html), ("three.js", &three)] {
        // A namespace is a name, not a place.
        let text = text.replace("http://www.w3.org/1999/xhtml", "");
        for request in [
            "http://",
            "https://",
            "ws://",
            "wss://",
            "fetch(",
            "import(",
            "XMLHttpRequest",
            "WebSocket",
            "EventSource",
            "sendBeacon",
            "importScripts",
            "@import",
            "url(",
            "<iframe",
            " src=",
            "<a ",
        ] {
            assert!(!text.contains(request), "{what} holds {request}");
        }
    }
    assert_eq!(html.matches("href=").count(), html.matches("<link rel=\"icon\" href=\"data:,\">").count());
    assert!(html.contains("Copyright © 2010-2026 three.js authors") && html.contains("WITHOUT WARRANTY"));
}

#[test]
fn equal_input_gives_equal_bytes() {
    let make = || page(Some(&classes()), Some(&scene()), "a", &Palette::of(17)).unwrap();
    assert!(make() == make());
}

/// What is done to a sound scene.
type Change = &'static dyn Fn(&mut Scene);

#[test]
fn what_does_not_fit_is_refused() {
    let refused = |truth: Option<&[u8]>, change: &dyn Fn(&mut Scene)| {
        let mut scene = scene();
        change(&mut scene);
        page(truth, Some(&scene), "", &Palette::of(17)).unwrap_err()
    };
    let error = refused(Some(&[0; 59]), &|_| ());
    assert_eq!((error.kind(), error.message()), (ErrorKind::Mismatch, "truth of 59 voxels, expected 60"));
    let cases: [(Change, &str); 6] = [
        (&|s| s.names.truncate(1), "scene of 1 names, 2 images, 2 matrices"),
        (&|s| s.lidar2img.clear(), "scene of 2 names, 2 images, 0 matrices"),
        (&|s| s.lidar2img[0][7] = f32::NAN, "camera CAM_FRONT: lidar2img is not finite"),
        (&|s| s.images[0].bgr.truncate(17), "camera CAM_FRONT: 17 bytes of pixels, expected 500 x 1300 x 3"),
        (&|s| s.images[0].width = 0, "expected 500 x 0 x 3"),
        (&|s| s.images[0].height = usize::MAX, "bytes of pixels"),
    ];
    for (change, expected) in cases {
        let error = refused(None, change);
        assert!(error.kind() == ErrorKind::Format && error.message().contains(expected), "{error}");
    }
}

#[test]
fn the_file_is_written_whole() {
    let directory = tempfile::tempdir().unwrap();
    let classes = classes();
    let prediction = Occupancy::new("", &classes, Grid::new(GRID, BOUNDS), [0.0, 1.0]).unwrap();
    let palette = Palette::of(17);
    let page = Page { title: "t", subtitle: "", prediction, truth: None, scene: None, palette: &palette };
    let path = directory.path().join("out.html");
    page.write(&path).unwrap();
    assert_eq!(std::fs::read_to_string(&path).unwrap(), page.to_html().unwrap());
    let error = page.write(&directory.path().join("no/out.html")).unwrap_err();
    assert_eq!(error.kind(), ErrorKind::Io);
}
