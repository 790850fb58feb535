//! The page as a reader meets it: what is drawn, what every control does to it, and what is not asked of a network.

use image::RgbImage;
use std::path::PathBuf;
use tempfile::TempDir;
use voxcast::Scene;
use voxcast::eval::Confusion;
use voxcast::html::Page;
use voxcast::network::Grid;
use voxcast::picture::{Class, Occupancy, Palette};
use voxcast::scene::Image;
use voxcast::synth::Synthesiser;
use voxcast_viewer::{Browser, DESK, Screen};

const RIGHT: &str = "\u{e014}";
const HOME: &str = "\u{e011}";
const ENTER: &str = "\u{e007}";

/// A copy to read from: the browser warns of reading twice from what is drawn on.
const COPIED: &str = "function copied(selector) {
    const from = document.querySelector(selector);
    const copy = document.createElement('canvas');
    [copy.width, copy.height] = [from.width, from.height];
    copy.getContext('2d').drawImage(from, 0, 0);
    return copy.getContext('2d');
}";

/// A grid with all that belongs to it.
struct World {
    grid: [usize; 3],
    bounds: [[f32; 2]; 3],
    forward: [f32; 2],
    classes: Vec<u8>,
    truth: Option<Vec<u8>>,
    support: Vec<u16>,
    confidence: Vec<u8>,
    scene: Option<Scene>,
    palette: Palette,
    title: String,
    directory: TempDir,
}

impl World {
    /// One voxel, a car, in the middle of the lowest layer of a small grid, ahead of one camera.
    fn single() -> Self {
        let grid = [5, 5, 3];
        let mut classes = vec![0; 75];
        classes[(2 * 5 + 2) * 3] = 4;
        // At (-6, 0, -0.5), looking along +x with a focal length of 100 pixels; x is at 50, y at 30.
        let lidar2img = [50., -100., 0., 300., 30., 0., -100., 130., 1., 0., 0., 6., 0., 0., 0., 1.];
        let image = Image { height: 60, width: 100, bgr: [40, 90, 40].repeat(6000) };
        Self {
            grid,
            bounds: [[-2.5, 2.5], [-2.5, 2.5], [-1.0, 2.0]],
            forward: [1.0, 0.0],
            classes,
            truth: None,
            support: vec![7; 75],
            confidence: vec![204; 75],
            scene: Some(Scene { names: vec!["CAM_FRONT".into()], images: vec![image], lidar2img: vec![lidar2img] }),
            palette: Palette::of(17),
            title: "single.npz".into(),
            directory: tempfile::tempdir_in(env!("CARGO_TARGET_TMPDIR")).unwrap(),
        }
    }

    /// A drawn street as truth, and a prediction that errs in known ways: it takes cars for trucks, misses people, invents
    /// barriers on a plane, and part of the truth has no label.
    fn street() -> Self {
        let network = voxcast::Network::built_in("edge").unwrap();
        let frame = Synthesiser::new(&network).unwrap().frame(1_000_006);
        let grid = network.output_grid();
        let mut truth = frame.labels;
        let mut classes = truth.clone();
        for (index, class) in classes.iter_mut().enumerate() {
            let [x, z] = [index / (grid[1] * grid[2]), index % grid[2]];
            *class = match *class {
                4 => 10,
                7 => 0,
                0 if z == 5 && x < 20 => 1,
                same => same,
            };
            if x >= 100 {
                truth[index] = 255;
            }
        }
        // Sure of all but the half with x below 0.
        let confidence =
            (0..classes.len()).map(|i| if 2 * (i / (grid[1] * grid[2])) < grid[0] { 100 } else { 255 }).collect();
        let support = frame.visible.iter().map(|&seen| 3 * u16::from(seen)).collect();
        Self {
            grid,
            bounds: network.bounds,
            forward: [0.0, 1.0],
            classes,
            truth: Some(truth),
            support,
            confidence,
            scene: Some(frame.scene),
            palette: Palette::of(17),
            title: "street.npz".into(),
            directory: tempfile::tempdir_in(env!("CARGO_TARGET_TMPDIR")).unwrap(),
        }
    }

    /// The page as a file.
    fn write(&self) -> PathBuf {
        let prediction = Occupancy::new("", &self.classes, Grid::new(self.grid, self.bounds), self.forward).unwrap();
        let page = Page {
            title: &self.title,
            subtitle: "of a test",
            prediction: prediction.with_support(&self.support).unwrap().with_confidence(&self.confidence).unwrap(),
            truth: self.truth.as_deref(),
            scene: self.scene.as_ref(),
            palette: &self.palette,
        };
        let path = self.directory.path().join("page.html");
        page.write(&path).unwrap();
        path
    }

    fn open(&self, screen: Screen) -> Browser {
        let browser = Browser::start(screen);
        browser.open(&self.write());
        settle(&browser);
        browser
    }
}

/// Waits until nothing moves and voxels lie on the images; without WebGL nothing ever moves.
fn settle(browser: &Browser) {
    browser.wait(
        "const { resting = 'true', laid } = document.getElementById('space').dataset; \
         return resting === 'true' && laid === 'true'",
    );
}

fn fact(browser: &Browser, name: &str) -> String {
    let value = browser.run(&format!("return document.getElementById('space').dataset.{name}"));
    value.as_str().unwrap_or_else(|| panic!("{name}: {value}")).to_owned()
}

fn triangles(browser: &Browser) -> usize {
    fact(browser, "triangles").parse().unwrap()
}

fn text(browser: &Browser, id: &str) -> String {
    browser.run(&format!("return document.getElementById('{id}').innerText")).as_str().unwrap().to_owned()
}

/// The part of the window in which voxels are drawn, without the controls on it.
fn stage(browser: &Browser) -> RgbImage {
    let place = browser.run(
        "const r = document.getElementById('stage').getBoundingClientRect(); \
         const d = devicePixelRatio; return [r.left * d, r.top * d, r.width * d, r.height * d].map(Math.round)",
    );
    let place: Vec<u32> = serde_json::from_value(place).unwrap();
    let picture = browser.picture();
    let [left, top] = [place[0] + 4, place[1] + 60];
    let [width, height] = [place[2] - 8, (place[3] - 120).min(picture.height() - top)];
    image::imageops::crop_imm(&picture, left, top, width, height).to_image()
}

/// Pixels of about the hue of `rgb`, however lit.
fn count(picture: &RgbImage, rgb: [u8; 3]) -> usize {
    let unit = |p: [u8; 3]| {
        let length = p.iter().map(|&v| f64::from(v).powi(2)).sum::<f64>().sqrt().max(1.0);
        p.map(|v| f64::from(v) / length)
    };
    let wanted = unit(rgb);
    let alike = |p: [u8; 3]| {
        let bright = p.iter().copied().max() > Some(60);
        bright && unit(p).iter().zip(wanted).map(|(a, b)| a * b).sum::<f64>() > 0.998
    };
    picture.pixels().filter(|p| alike(p.0)).count()
}

fn differing(a: &RgbImage, b: &RgbImage) -> usize {
    assert_eq!(a.dimensions(), b.dimensions());
    a.pixels().zip(b.pixels()).filter(|(a, b)| a.0.iter().zip(b.0).any(|(&a, b)| a.abs_diff(b) > 24)).count()
}

fn group(n: usize) -> String {
    format!("#classes input[data-group='{n}']")
}

fn layer(key: &str) -> String {
    format!("#layers label:has(input[value='{key}'])")
}

fn unseen(key: &str) -> String {
    format!("#unseen label:has(input[value='{key}'])")
}

fn quiet(browser: &Browser) {
    let said = browser.said();
    assert!(said.is_empty(), "the console has {said:?}");
}

#[test]
fn classes_are_drawn_and_switched() {
    let world = World::street();
    let browser = world.open(DESK);
    let all = triangles(&browser);
    let picture = stage(&browser);
    let terrain = [150, 240, 80];
    assert!(all > 3000 && count(&picture, terrain) > 2000, "{all} triangles, {} of it", count(&picture, terrain));

    browser.click(&group(14));
    settle(&browser);
    let without = stage(&browser);
    assert!(triangles(&browser) != all && count(&without, terrain) < 50, "{} of it", count(&without, terrain));
    browser.click(&group(14));
    settle(&browser);
    assert_eq!((triangles(&browser), differing(&stage(&browser), &picture)), (all, 0));

    browser.click("#none");
    settle(&browser);
    assert_eq!((triangles(&browser), count(&stage(&browser), terrain)), (0, 0));
    browser.click("#all");
    settle(&browser);
    assert_eq!((triangles(&browser), differing(&stage(&browser), &picture)), (all, 0));

    // The legend counts what there is.
    let number = world.classes.iter().filter(|&&c| c == 14).count();
    let shown = browser.run("return document.querySelector(\"label:has([data-group='14']) .count\").innerText");
    assert_eq!(shown.as_str().unwrap().replace('\u{2009}', ""), number.to_string());
    quiet(&browser);
}

#[test]
fn truth_and_difference_share_the_viewpoint() {
    let world = World::street();
    let truth = world.truth.as_ref().unwrap();
    let browser = world.open(DESK);
    let (camera, prediction) = (fact(&browser, "camera"), stage(&browser));
    browser.click(&layer("truth"));
    settle(&browser);
    let true_picture = stage(&browser);
    assert!(fact(&browser, "layer") == "truth" && fact(&browser, "camera") == camera);
    // Trucks that are cars.
    assert!(differing(&prediction, &true_picture) > 500);
    assert!(count(&true_picture, [0, 150, 245]) > count(&prediction, [0, 150, 245]) + 100);

    browser.click(&layer("difference"));
    settle(&browser);
    let picture = stage(&browser);
    assert!(fact(&browser, "layer") == "difference" && fact(&browser, "camera") == camera);
    let mut counts = [0usize; 5];
    let mut confusion = Confusion::new(17);
    for (&truth, &class) in truth.iter().zip(&world.classes).filter(|(t, _)| **t != 255) {
        confusion.add(truth, class);
        counts[match (truth, class) {
            (0, 0) => 0,
            (t, c) if t == c => 1,
            (_, 0) => 3,
            (0, _) => 4,
            _ => 2,
        }] += 1;
    }
    assert!(counts.iter().all(|&n| n > 0), "{counts:?}");
    for (kind, rgb) in [(1, [0, 158, 115]), (2, [240, 190, 40]), (4, [204, 90, 150])] {
        let shown = browser
            .run(&format!("return document.querySelector(\"label:has([data-group='{kind}']) .count\").innerText"));
        assert_eq!(shown.as_str().unwrap().replace('\u{2009}', ""), counts[kind].to_string());
        let before = count(&picture, rgb);
        assert!(before > 20, "{before} pixels of kind {kind}");
        browser.click(&group(kind));
        settle(&browser);
        let after = count(&stage(&browser), rgb);
        assert!(after * 10 < before, "{after} of {before} pixels of kind {kind} are left");
        browser.click(&group(kind));
    }
    let percent = |v: Option<f64>| format!("{:.1} %", 100.0 * v.unwrap());
    let expected = format!("IoU {}, mIoU {}", percent(confusion.iou()), percent(confusion.mean_iou()));
    assert_eq!(text(&browser, "score"), expected);
    assert!(text(&browser, "facts").contains(&expected));
    quiet(&browser);
}

#[test]
fn layers_are_sliced_with_the_keyboard() {
    let world = World::street();
    let browser = world.open(DESK);
    let all = triangles(&browser);
    assert_eq!(text(&browser, "height"), "−5.30 to 2.70 m");
    browser.press("#low", &RIGHT.repeat(4));
    settle(&browser);
    assert_eq!(text(&browser, "height"), "−1.30 to 2.70 m");
    let (sliced, ground) = (triangles(&browser), count(&stage(&browser), [255, 0, 255]));
    assert!(sliced < all && sliced > 0 && ground < 200, "{sliced} of {all} triangles, {ground} pixels of road");
    // Thumbs do not pass each other.
    browser.press("#high", HOME);
    settle(&browser);
    assert_eq!(text(&browser, "height"), "−1.30 to −0.30 m");
    browser.press("#low", HOME);
    browser.press("#high", "\u{e010}");
    settle(&browser);
    assert_eq!((text(&browser, "height").as_str(), triangles(&browser)), ("−5.30 to 2.70 m", all));
    quiet(&browser);
}

#[test]
fn what_is_less_likely_is_hidden() {
    let world = World::street();
    let browser = world.open(DESK);
    let (all, pictured) = (triangles(&browser), stage(&browser));
    assert_eq!(text(&browser, "likely"), "all");
    browser.press("#least", "\u{e010}");
    settle(&browser);
    assert_eq!(text(&browser, "likely"), "from 100 %");
    let (sure, left) = (triangles(&browser), stage(&browser));
    assert!(sure > all / 5 && sure < 4 * all / 5, "{sure} of {all} triangles");
    assert!(differing(&pictured, &left) > 2000, "{} pixels", differing(&pictured, &left));
    // The truth is what it is.
    browser.click(&layer("truth"));
    settle(&browser);
    let truth = triangles(&browser);
    browser.press("#least", HOME);
    settle(&browser);
    assert_eq!((triangles(&browser), text(&browser, "likely").as_str()), (truth, "all"));
    browser.click(&layer("prediction"));
    settle(&browser);
    assert_eq!(triangles(&browser), all);
    quiet(&browser);
}

#[test]
fn free_and_unknown_are_told_apart() {
    let world = World::street();
    let guesses = world.classes.iter().zip(&world.support).filter(|(c, s)| **c != 0 && **s == 0).count();
    assert!(guesses > 100, "{guesses} guesses");
    let browser = world.open(DESK);
    let (hatched, pictured) = (triangles(&browser), stage(&browser));
    browser.click(&unseen("solid"));
    settle(&browser);
    let solid = stage(&browser);
    assert!(differing(&pictured, &solid) > 500, "{}", differing(&pictured, &solid));
    browser.click(&unseen("hidden"));
    settle(&browser);
    let hidden = stage(&browser);
    assert!(triangles(&browser) != hatched && differing(&hidden, &solid) > 500 && differing(&hidden, &pictured) > 500);
    let before = triangles(&browser);
    browser.click("#unknown");
    settle(&browser);
    assert!(triangles(&browser) > before && differing(&stage(&browser), &hidden) > 5000);
    quiet(&browser);
}

#[test]
fn the_theme_turns() {
    let browser = World::single().open(DESK);
    let brightness = |browser: &Browser| {
        let picture = stage(browser);
        let sum: u64 = picture.pixels().map(|p| p.0.iter().map(|&v| u64::from(v)).sum::<u64>()).sum();
        sum / (3 * u64::from(picture.width() * picture.height()))
    };
    let light = brightness(&browser);
    browser.click("#theme");
    settle(&browser);
    let dark = brightness(&browser);
    assert!(light > 180 && dark < 70, "{light} to {dark}");
    browser.click("#theme");
    settle(&browser);
    assert_eq!(brightness(&browser), light);

    // Until the reader chooses, the page follows the system.
    let browser = World::single().open(DESK);
    browser.prefer("dark");
    settle(&browser);
    assert_eq!(brightness(&browser), dark);
    browser.click("#theme");
    settle(&browser);
    assert_eq!(brightness(&browser), light);
    quiet(&browser);
}

#[test]
fn an_image_leads_to_its_camera_and_voxels_lie_on_it() {
    let world = World::single();
    let browser = world.open(DESK);
    let before = stage(&browser);
    // The voxel's middle is (0, 0, -0.5), 6 m ahead: u = 300 / 6, v = (50 + 130) / 6. Its near face is 5.5 m ahead and
    // reaches from u = 50 - 50 / 5.5 = 40.9 to 59.1.
    let pixel = |u: u32, v: u32| {
        let script = format!("{COPIED} return [...copied('#images canvas').getImageData({u}, {v}, 1, 1).data]");
        serde_json::from_value::<[u8; 4]>(browser.run(&script)).unwrap()
    };
    let [red, green, blue, opaque] = pixel(50, 30).map(f64::from);
    assert!(
        opaque == 255.0 && blue > 120.0 && red < 20.0 && (green / blue - 150.0 / 245.0).abs() < 0.05,
        "a car's side"
    );
    assert_eq!([39, 42, 57, 61].map(|u| pixel(u, 30)[3]), [0, 255, 255, 0]);

    browser.click("#images button");
    settle(&browser);
    let camera: Vec<f64> = fact(&browser, "camera").split(' ').map(|v| v.parse().unwrap()).collect();
    for (found, expected) in camera.iter().zip([-6.0, 0.0, -0.5, 2.0, 0.0, -0.5]) {
        assert!((found - expected).abs() < 0.01, "{camera:?}");
    }
    // From there the car is in the middle of the picture.
    let picture = stage(&browser);
    let middle = *picture.get_pixel(picture.width() / 2, picture.height() / 2);
    assert!(middle.0[2] > 150 && middle.0[0] < 40, "{middle:?}");
    assert!(differing(&before, &picture) > 2000);

    browser.click("label:has(#overlay)");
    browser.wait("return document.querySelector('#images canvas').hidden");
    browser.click("[data-view='home']");
    settle(&browser);
    assert_eq!(differing(&before, &stage(&browser)), 0);
    quiet(&browser);
}

#[test]
fn what_is_hidden_does_not_show_on_an_image() {
    let mut world = World::single();
    // A truck a metre behind the car, seen from the camera.
    world.classes[(4 * world.grid[1] + 2) * world.grid[2]] = 10;
    let browser = world.open(DESK);
    let trucks = |browser: &Browser| {
        let script = format!(
            "{COPIED} const {{ data }} = copied('#images canvas').getImageData(0, 0, 100, 50); let n = 0; \
             for (let i = 0; i < data.length; i += 4) n += data[i + 3] === 255 && data[i] > 60 && data[i + 1] < 60; return n"
        );
        browser.run(&script).as_u64().unwrap()
    };
    assert_eq!(trucks(&browser), 0);
    browser.click("label:has([data-group='4'])");
    settle(&browser);
    // 100 pixels a metre at one metre: the truck's near face is 7.5 m away.
    let seen = trucks(&browser);
    assert!((110..190).contains(&seen), "{seen} of 178 pixels");
    quiet(&browser);
}

#[test]
fn a_context_that_is_lost_comes_back() {
    let browser = World::single().open(DESK);
    let before = stage(&browser);
    browser.run(
        "window.context = document.getElementById('space').getContext('webgl2').getExtension('WEBGL_lose_context'); \
         window.context.loseContext()",
    );
    browser.wait("return !document.getElementById('message').hidden");
    browser.run("window.context.restoreContext()");
    browser.wait("return document.getElementById('message').hidden");
    settle(&browser);
    assert_eq!(differing(&before, &stage(&browser)), 0);
}

#[test]
fn a_voxel_says_what_it_is() {
    let world = World::single();
    let browser = world.open(DESK);
    browser.click("[data-view='top']");
    settle(&browser);
    let expected =
        ["car", "voxel 2, 2, 0", "x 0.00  y 0.00  z −0.50 m", "occupied with 80.0 %", "seen by 7 feature pixels"];
    browser.press("#space", ENTER);
    let spoken = browser.run("return document.getElementById('spoken').textContent").as_str().unwrap().to_owned();
    assert!(expected.iter().all(|part| spoken.contains(part)), "{spoken}");
    browser.run("document.getElementById('tip').hidden = true");

    let middle = "const r = document.getElementById('stage').getBoundingClientRect(); \
                  return [r.left + r.width / 2, r.top + r.height / 2]";
    let middle: [f64; 2] = serde_json::from_value(browser.run(middle)).unwrap();
    browser.point(middle);
    browser.wait("return !document.getElementById('tip').hidden");
    let tip = text(&browser, "tip");
    assert!(expected.iter().all(|part| tip.contains(part)), "{tip}");
    browser.point([middle[0] - 300.0, middle[1]]);
    browser.wait("return document.getElementById('tip').hidden");

    // A drag and the arrow keys turn, and say nothing.
    let before = fact(&browser, "camera");
    browser.drag(middle, [middle[0] + 120.0, middle[1] - 60.0]);
    settle(&browser);
    let dragged = fact(&browser, "camera");
    browser.press("#space", RIGHT);
    settle(&browser);
    assert!(before != dragged && dragged != fact(&browser, "camera"));
    quiet(&browser);
}

#[test]
fn without_webgl_the_page_says_so_and_draws_from_above() {
    let mut world = World::street();
    // Ahead and to the right of the vehicle: up and to the right in the picture.
    world.classes.fill(0);
    world.support.fill(1);
    world.classes[(100 * world.grid[1] + 102) * world.grid[2] + 1] = 4;
    let browser = world.open(Screen { webgl: false, ..DESK });
    assert!(text(&browser, "message").contains("no WebGL"));
    let script = format!(
        "{COPIED} const {{ canvas, width = canvas.width }} = copied('#flat');
        const d = copied('#flat').getImageData(0, 0, width, canvas.height).data;
        const found = [];
        for (let i = 0; i < d.length; i += 4) {{
            if (d[i + 3]) found.push(i / 4 % width, Math.floor(i / 4 / width), ...d.subarray(i, i + 3));
        }}
        return found;"
    );
    assert_eq!(browser.run(&script), serde_json::json!([100, 1, 0, 150, 245]));
    browser.click(&group(4));
    assert_eq!(browser.run(&script), serde_json::json!([]));
    let said = browser.said();
    assert!(said.iter().all(|line| line.contains("WebGL")), "{said:?}");
}

#[test]
fn hostile_names_are_text() {
    let mut world = World::single();
    let name = "</script><img src=x onerror='window.hacked = 1'><script>window.hacked = 2</script>";
    world.title = name.to_owned();
    world.palette = Palette::new((0..17).map(|k| Class { name: format!("{name}{k}"), rgb: [200, k, 0] }).collect());
    world.scene.as_mut().unwrap().names[0] = name.to_owned();
    let browser = world.open(DESK);
    browser.press("#space", ENTER);
    assert_eq!(browser.run("return window.hacked || 'no'"), "no");
    assert_eq!(browser.run("return performance.getEntriesByType('resource').length"), 0, "nothing was asked for");
    assert_eq!(browser.run("return document.querySelectorAll('img').length"), 1);
    assert_eq!((text(&browser, "title"), browser.run("return document.title")), (name.to_owned(), name.into()));
    assert!(browser.run("return document.querySelector('#classes .name').textContent") == format!("{name}4"));
    quiet(&browser);
}

#[test]
fn a_telephone_shows_everything_in_its_width() {
    for width in [390, 360] {
        let world = World::street();
        let browser = world.open(Screen { size: [width, 844], phone: true, webgl: true });
        let wide = browser.run("return [document.documentElement.scrollWidth, innerWidth]");
        assert_eq!(wide, serde_json::json!([width, width]));
        let outside = browser.run(
            "return [...document.querySelectorAll('button, input, h1, h2, dd, label')].filter((e) => { \
             const r = e.getBoundingClientRect(); \
             return r.width > 0 && !e.closest('#images') && (r.left < 0 || r.right > innerWidth + 0.5); \
             }).map((e) => e.outerHTML)",
        );
        assert_eq!(outside, serde_json::json!([]));
        let middle = "const r = document.getElementById('stage').getBoundingClientRect(); \
                      return [r.left + r.width / 2, r.top + r.height / 2]";
        browser.tap(serde_json::from_value(browser.run(middle)).unwrap());
        browser.wait("return !document.getElementById('tip').hidden");
        assert!(text(&browser, "tip").contains("voxel "));
        quiet(&browser);
    }
}

/// Sides of occupied voxels with nothing before them.
fn open_sides(classes: &[u8], [nx, ny, nz]: [usize; 3]) -> usize {
    let steps = [ny * nz, nz, 1];
    let mut open = 0;
    for at in (0..classes.len()).filter(|&at| classes[at] != 0) {
        let place = [at / steps[0], at / nz % ny, at % nz];
        for ((step, index), length) in steps.into_iter().zip(place).zip([nx, ny, nz]) {
            open += usize::from(index == 0 || classes[at - step] == 0);
            open += usize::from(index + 1 == length || classes[at + step] == 0);
        }
    }
    open
}

#[test]
fn a_large_grid_takes_few_triangles() {
    let grid = [256, 256, 32];
    let mut classes = vec![0u8; grid.iter().product()];
    // Hilly ground with blocks and speckles on it: far more faces than a street has.
    let mut seed = 1u32;
    let mut random = || {
        seed = seed.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        seed >> 16
    };
    for x in 0..grid[0] {
        for y in 0..grid[1] {
            let ground = 4 + (x / 24 + y / 31) % 3;
            let block = if (x / 18 + 3 * (y / 14)) % 7 == 0 { 12 + x % 5 } else { 0 };
            let column = &mut classes[(x * grid[1] + y) * grid[2]..][..grid[2]];
            column[..ground].fill(9 + ((x / 40 + y / 60) % 3) as u8);
            column[ground..ground + block].fill(13);
            if random() % 9 == 0 {
                column[ground + block] = 1 + (random() % 19) as u8;
            }
        }
    }
    let mut world = World::single();
    world.support = classes.iter().enumerate().map(|(i, _)| u16::from(i / (256 * 32) % 256 > 20)).collect();
    world.confidence = vec![255; classes.len()];
    (world.grid, world.classes, world.scene) = (grid, classes, None);
    (world.bounds, world.palette) = ([[0.0, 51.2], [-25.6, 25.6], [-2.0, 4.4]], Palette::of(20));
    let browser = world.open(DESK);
    // One triangle for each side that is open would be too many to turn.
    let sides = open_sides(&world.classes, grid);
    let first = triangles(&browser);
    assert!(first > 50_000 && first < sides, "{first} triangles for {sides} open sides");
    browser.click(&group(13));
    settle(&browser);
    assert!((1..first).contains(&triangles(&browser)), "{first} triangles, then {}", triangles(&browser));
    quiet(&browser);
}
