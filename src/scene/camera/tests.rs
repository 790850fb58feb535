use super::*;
use serde_json::json;

fn direct() -> Value {
    json!({"name": "a", "file": "img/a.png", "width": 20, "height": 10, "extra": [null],
        "lidar2img": [[1, 2, 3, 4], [5, 6, 7, 8], [9, 10, 12, 12], [0, 0, 0, 1.0]]})
}

fn product() -> Value {
    json!({"name": "b", "file": "b.png", "width": 20, "height": 10,
        "intrinsic": [[100.0, 0.0, 10.0], [0.0, 200.0, 5.0], [0.0, 0.0, 1.0]],
        "lidar2camera": [[0, -1, 0, 0.5], [0, 0, -1, 0.25], [1, 0, 0, -2], [0, 0, 0, 1]]})
}

fn read(cameras: &[Value]) -> Result<Vec<Camera>> {
    read_calibration(&json!({"source": "x", "cameras": cameras}).to_string())
}

#[test]
fn both_forms_by_hand() {
    let cameras = read(&[direct(), product()]).unwrap();
    assert_eq!((cameras[0].name.as_str(), cameras[0].file.as_str()), ("a", "img/a.png"));
    assert_eq!((cameras[0].width, cameras[0].height), (20, 10));
    let expected = [1., 2., 3., 4., 5., 6., 7., 8., 9., 10., 12., 12., 0., 0., 0., 1.];
    assert_eq!(cameras[0].lidar2img, expected);
    // Row 0: 100 * (0, -1, 0, 0.5) + 10 * (1, 0, 0, -2); row 1: 200 * (0, 0, -1, 0.25) + 5 * (1, 0, 0, -2).
    let expected = [10., -100., 0., 30., 5., 0., -200., 40., 1., 0., 0., -2., 0., 0., 0., 1.];
    assert_eq!(cameras[1].lidar2img, expected);
}

#[test]
fn the_product_is_rounded_once() {
    let mut camera = product();
    // In f32, 2^24 + 1 loses its last bit before the subtraction; in f64 the difference is exactly 1.
    camera["intrinsic"][0] = json!([16_777_217.0, 0.0, -16_777_216.0]);
    camera["lidar2camera"] = json!([[1, 0, 0, 1], [0, 1, 0, 0], [0, 0, 1, 1], [0, 0, 0, 1]]);
    assert_eq!(read(&[camera]).unwrap()[0].lidar2img[3], 1.0);
}

#[test]
fn a_matrix_that_is_given_goes_first() {
    let mut camera = product();
    camera["lidar2img"] = direct()["lidar2img"].clone();
    assert_eq!(read(&[camera]).unwrap()[0].lidar2img[3], 4.0);
}

#[test]
fn wrong_keys_are_named() {
    let cases = [
        (direct(), "/name", json!(3), "camera 1: \"name\" is 3"),
        (direct(), "/name", json!(""), "camera 1: \"name\" is an empty string"),
        (direct(), "/file", json!("../b"), "\"file\" is \"../b\", expected a path inside"),
        (direct(), "/file", json!("a/../../b"), "inside the calibration's directory"),
        (direct(), "/file", json!("/etc/passwd"), "inside the calibration's directory"),
        (direct(), "/file", json!("..\\b"), "inside the calibration's directory"),
        (direct(), "/width", json!(0), "\"width\" is 0, expected 1 to 65536"),
        (direct(), "/height", json!(2.5), "\"height\" is 2.5"),
        (direct(), "/height", json!(65537), "\"height\" is 65537"),
        (direct(), "/height", json!(-3), "\"height\" is -3"),
        (direct(), "/lidar2img", json!([[1]]), "\"lidar2img\" is 1 rows, expected 4 rows of 4 numbers"),
        (direct(), "/lidar2img/2", json!([1, 2, 3]), "\"lidar2img\" is a list of 3 in row 2"),
        (direct(), "/lidar2img/2", json!("x"), "a string in row 2"),
        (direct(), "/lidar2img/1/3", json!("x"), "a string in row 1, column 3"),
        (direct(), "/lidar2img/1/3", json!(1e39), "\"lidar2img\" is 1e39 in row 1, column 3, expected finite"),
        (direct(), "/lidar2img", json!(null), "\"lidar2img\" is null"),
        (product(), "/intrinsic", json!([[1, 0, 0], [0, 1, 0]]), "\"intrinsic\" is 2 rows, expected 3 rows of 3"),
        (product(), "/intrinsic/0/0", json!(1e300), "\"intrinsic\" is"),
        (product(), "/lidar2camera/3", json!([0, 0, 1]), "\"lidar2camera\" is a list of 3 in row 3"),
        (product(), "/lidar2camera", json!({}), "\"lidar2camera\" is an object"),
        (product(), "", json!(7), "camera 1: 7, expected an object"),
    ];
    for (mut camera, pointer, value, expected) in cases {
        *camera.pointer_mut(pointer).unwrap() = value;
        let e = read(&[direct(), camera]).unwrap_err();
        assert!(e.message().contains(expected), "{e} (expected {expected})");
        assert!(e.message().starts_with("camera 1"), "{e}");
    }
}

#[test]
fn missing_keys_are_named() {
    for (camera, keys) in
        [(direct(), &["name", "file", "width", "height", "lidar2img"][..]), (product(), &["intrinsic", "lidar2camera"])]
    {
        for key in keys {
            let mut camera = camera.clone();
            camera.as_object_mut().unwrap().remove(*key);
            let e = read(&[camera]).unwrap_err();
            assert!(e.message().contains("missing"), "{e}");
            assert!(e.message().contains(key), "{e}");
        }
    }
}

#[test]
fn what_is_no_calibration_is_refused() {
    let good = json!({"cameras": [direct()]}).to_string();
    assert!(read_calibration(&good).is_ok());
    for n in 0..good.len() {
        assert!(read_calibration(&good[..n]).is_err(), "cut to {n} bytes");
    }
    for text in ["[]", "{}", "{\"cameras\":[]}", "{\"cameras\":{}}", "{\"cameras\":[null]}"] {
        assert!(read_calibration(text).is_err(), "{text}");
    }
    let nan = good.replace("1.0", "NaN");
    assert!(read_calibration(&nan).unwrap_err().message().starts_with("calibration JSON"));
    let infinite = good.replace("1.0", "1e999");
    assert!(read_calibration(&infinite).is_err());
}

/// Edits of sound cameras, each with what is said: an error, or a note.
#[test]
fn matrices_must_be_what_they_are_called() {
    let turned = json!([[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0.5, 0.25, -2, 1]]);
    for (key, value, expected) in [
        ("lidar2camera", turned, "\"lidar2camera\" is [0.5, 0.25, -2.0, 1.0] in row 3, as if transposed"),
        ("lidar2camera", json!([[0, -2, 0, 1], [0, 0, -2, 1], [2, 0, 0, 1], [0, 0, 0, 1]]), "scaled: row 0"),
        ("lidar2camera", json!([[0, -1, 0, 1], [0, 0, -1, 1], [1.004, 0, 0, 1], [0, 0, 0, 1]]), "scaled: row 2"),
        ("lidar2camera", json!([[0, -1, 0, 1], [0, 0, -1, 1], [1, 0.1, 0, 1], [0, 0, 0, 1]]), "skewed: rows 0 and 2"),
        ("lidar2camera", json!([[0, 1, 0, 1], [0, 0, -1, 1], [1, 0, 0, 1], [0, 0, 0, 1]]), "mirrored"),
        ("lidar2camera", json!([[0, 0, 0, 0], [0, 0, 0, 0], [0, 0, 0, 0], [0, 0, 0, 1]]), "row 0 of its rotation"),
        ("intrinsic", json!([[100, 0, 0], [0, 200, 0], [10, 5, 1]]), "as if transposed"),
        ("intrinsic", json!([[0.1, 0, 0.01], [0, 0.2, 0.005], [0, 0, 0.001]]), "0.001 in row 2, column 2"),
        ("intrinsic", json!([[-100, 0, 10], [0, 200, 5], [0, 0, 1]]), "-100 in row 0, column 0"),
        ("intrinsic", json!([[100, 0, 10], [3, 200, 5], [0, 0, 1]]), "3 in row 1, column 0"),
        ("lidar2img", json!([[1, 2, 3, 0], [5, 6, 7, 0], [9, 10, 12, 0], [4, 8, 12, 1]]), "as if transposed"),
        ("lidar2img", json!([[1, 2, 3, 4], [2, 4, 6, 8], [9, 10, 12, 12], [0, 0, 0, 1]]), "singular"),
    ] {
        let mut camera = if key == "lidar2img" { direct() } else { product() };
        camera[key] = value;
        let error = read(&[camera]).expect_err(expected);
        assert!(error.message().starts_with("camera 0 (") && error.message().contains(key), "{error}");
        assert!(error.message().contains(expected), "{error} (expected {expected})");
    }
}

/// What reading two cameras says, of which the second has `key` set.
fn noted(mut camera: Value, key: &str, value: Value) -> Result<Vec<String>> {
    camera[key] = value;
    let text = json!({"cameras": [{"name": "x", "file": "x.png", "width": 9, "height": 9,
        "lidar2img": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}, camera]});
    let (_, notes) = read_calibration_with_notes(&text.to_string())?;
    Ok(notes.iter().map(ToString::to_string).collect())
}

#[test]
fn what_would_bend_rays_is_refused_unless_it_is_none() {
    for (key, value) in [
        ("distortion", json!([-0.3, 0.1, 0, 0, 0])),
        ("dist_coeffs", json!([0, 0, 0, 0, 1e-9])),
        ("distortion_coefficients", json!({"rows": 1, "cols": 5, "data": [0.1, 0, 0, 0, 0]})),
        ("distCoefs", json!([[0.1], [0], [0], [0]])),
        ("D", json!([0.1, 0, 0, 0])),
        ("k1", json!(-0.2)),
        ("p2", json!(0.001)),
        ("xi", json!(1.2)),
        ("camera_model", json!("fisheye")),
        ("distortion_model", json!("rational_polynomial")),
        ("is_fisheye", json!(true)),
        ("model", json!("MEI")),
    ] {
        let error = noted(product(), key, value).expect_err(key);
        assert_eq!(error.kind(), ErrorKind::Unsupported);
        assert!(error.message().contains(&format!("camera 1 (b): \"{key}\" is")), "{error}");
        assert!(error.message().contains("undistort the images first"), "{error}");
    }
    for (key, value) in [
        ("distortion", json!([0, 0.0, 0, 0, 0])),
        ("D", json!([])),
        ("k1", json!(0)),
        ("camera_model", json!("pinhole")),
        ("distortion_model", json!("plumb_bob")),
        ("distortion", json!(null)),
        ("is_fisheye", json!(false)),
    ] {
        assert_eq!(noted(product(), key, value).unwrap(), [""; 0], "{key}");
    }
    let top = json!({"cameras": [product()], "camera_model": "fisheye"}).to_string();
    assert!(read_calibration(&top).unwrap_err().message().starts_with("calibration: \"camera_model\""));
}

#[test]
fn keys_that_are_not_used_are_noted() {
    for (camera, key, value, expected) in [
        (product(), "timestamp", json!(1.5e9), ""),
        (product(), "source", json!("drawn"), ""),
        (product(), "camera2ego", json!([[1]]), "keys that are not used: camera2ego"),
        (product(), "Intrinsic", json!([[1]]), "keys that are not used: Intrinsic"),
        (product(), "post_rot", json!(0), "keys that are not used: post_rot"),
        (direct(), "intrinsic", json!([[1]]), "camera 1 (a): \"intrinsic\" is not used, \"lidar2img\" is"),
        (direct(), "lidar2camera", json!(1), "camera 1 (a): \"lidar2camera\" is not used, \"lidar2img\" is"),
        (product(), "lidar2img", direct()["lidar2img"].clone(), "is used, and is not the product"),
        (product(), "lidar2img", json!([[20, -200, 0, 60], [10, 0, -400, 80], [2, 0, 0, -4], [0, 0, 0, 1]]), ""),
        (
            product(),
            "lidar2img",
            json!([[-10, 100, 0, -30], [5, 0, -200, 40], [1, 0, 0, -2], [0, 0, 0, 1]]),
            "mirrors the image",
        ),
        (product(), "intrinsic", json!([[100, 0, 21], [0, 200, 5], [0, 0, 1]]), "its centre at (21, 5), outside"),
        (product(), "intrinsic", json!([[100, 0, 10], [0, 200, -1], [0, 0, 1]]), "its centre at (10, -1), outside"),
        (product(), "file", json!("x.png"), "cameras x and b have the same image, \"x.png\""),
    ] {
        let mut camera = camera;
        camera.as_object_mut().unwrap().remove("extra");
        let notes = noted(camera, key, value).unwrap();
        assert!(notes.iter().any(|note| note.contains(expected)) || expected.is_empty(), "{notes:?} lacks {expected}");
        assert_eq!(notes.is_empty(), expected.is_empty(), "{key}: {notes:?}");
    }
}

#[test]
fn names_and_keys_are_there_once() {
    let mut twin = product();
    twin["name"] = json!("a");
    let error = read(&[direct(), twin]).unwrap_err();
    assert!(error.message().contains("camera 1: \"name\" is a, as of camera 0"), "{error}");
    let text = json!({"cameras": [direct()]}).to_string().replacen("\"width\"", "\"width\":7,\"width\"", 1);
    let error = read_calibration(&text).unwrap_err();
    assert!(error.message().contains("key \"width\" is there twice"), "{error}");
}
