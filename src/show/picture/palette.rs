//! Names and colours of the classes.

/// One class: its name and its colour as 8-bit RGB.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Class {
    /// Name as papers print it.
    pub name: String,
    /// Red, green, blue.
    pub rgb: [u8; 3],
}

/// Names and colours of all classes of a network; class 0 is empty space and is never drawn.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Palette {
    classes: Vec<Class>,
}

/// nuScenes occupancy, classes 1 to 16, in the colours that SurroundOcc, Occ3D and their successors print.
const NUSCENES: [(&str, [u8; 3]); 16] = [
    ("barrier", [255, 120, 50]),
    ("bicycle", [255, 192, 203]),
    ("bus", [255, 255, 0]),
    ("car", [0, 150, 245]),
    ("construction vehicle", [0, 255, 255]),
    ("motorcycle", [200, 180, 0]),
    ("pedestrian", [255, 0, 0]),
    ("traffic cone", [255, 240, 150]),
    ("trailer", [135, 60, 0]),
    ("truck", [160, 32, 240]),
    ("driveable surface", [255, 0, 255]),
    ("other flat", [139, 137, 137]),
    ("sidewalk", [75, 0, 75]),
    ("terrain", [150, 240, 80]),
    ("manmade", [230, 230, 250]),
    ("vegetation", [0, 175, 0]),
];

/// SemanticKITTI, classes 1 to 19 of the benchmark, in the colours of its own configuration.
const SEMANTIC_KITTI: [(&str, [u8; 3]); 19] = [
    ("car", [100, 150, 245]),
    ("bicycle", [100, 230, 245]),
    ("motorcycle", [30, 60, 150]),
    ("truck", [80, 30, 180]),
    ("other vehicle", [100, 80, 250]),
    ("person", [255, 30, 30]),
    ("bicyclist", [255, 40, 200]),
    ("motorcyclist", [150, 30, 90]),
    ("road", [255, 0, 255]),
    ("parking", [255, 150, 255]),
    ("sidewalk", [75, 0, 75]),
    ("other ground", [175, 0, 75]),
    ("building", [255, 200, 0]),
    ("fence", [255, 120, 50]),
    ("vegetation", [0, 175, 0]),
    ("trunk", [135, 60, 0]),
    ("terrain", [150, 240, 80]),
    ("pole", [255, 240, 150]),
    ("traffic sign", [255, 0, 0]),
];

impl Palette {
    /// The palette of a network with `classes` classes, the empty class 0 among them: nuScenes' for 17, SemanticKITTI's for
    /// 20, otherwise names "class k" and colours that lie far apart.
    pub fn of(classes: usize) -> Self {
        let named = |list: &[(&str, [u8; 3])]| -> Vec<Class> {
            list.iter().map(|&(name, rgb)| Class { name: name.to_owned(), rgb }).collect()
        };
        let mut occupied = match classes {
            17 => named(&NUSCENES),
            20 => named(&SEMANTIC_KITTI),
            n => {
                let colours = separated(n.saturating_sub(1));
                colours.into_iter().zip(1..).map(|(rgb, k)| Class { name: format!("class {k}"), rgb }).collect()
            }
        };
        occupied.insert(0, Class { name: "empty".to_owned(), rgb: [255; 3] });
        Self { classes: occupied }
    }

    /// A palette of the caller's own. `classes[0]` stands for empty space; an empty list is taken as only that.
    pub fn new(mut classes: Vec<Class>) -> Self {
        if classes.is_empty() {
            classes.push(Class { name: "empty".to_owned(), rgb: [255; 3] });
        }
        Self { classes }
    }

    /// All classes in order, the empty one first.
    pub fn classes(&self) -> &[Class] {
        &self.classes
    }

    /// Whether voxels of `class` are drawn: it is neither empty space nor beyond the palette (255 marks voxels without a
    /// label in ground truth).
    pub fn is_drawn(&self, class: u8) -> bool {
        class != 0 && usize::from(class) < self.classes.len()
    }
}

/// `n` colours, each chosen to lie as far as possible from those before it and from white, as the eye judges distance.
fn separated(n: usize) -> Vec<[u8; 3]> {
    const STEPS: u16 = 10;
    let level = |i: u16| (i * 255 / (STEPS - 1)) as u8;
    let mut candidates = Vec::new();
    for r in 0..STEPS {
        for g in 0..STEPS {
            for b in 0..STEPS {
                let rgb = [level(r), level(g), level(b)];
                let lab = oklab(rgb);
                // Near-black and near-white would read as shadow and as background.
                if (0.30..0.92).contains(&lab[0]) {
                    candidates.push((rgb, lab));
                }
            }
        }
    }
    let distance = |a: [f32; 3], b: [f32; 3]| (0..3).map(|i| (a[i] - b[i]) * (a[i] - b[i])).sum::<f32>();
    let white = oklab([255; 3]);
    let mut nearest: Vec<f32> = candidates.iter().map(|c| distance(c.1, white)).collect();
    (0..n)
        .map(|_| {
            let best = (0..candidates.len()).fold(0, |best, i| if nearest[i] > nearest[best] { i } else { best });
            let (rgb, lab) = candidates[best];
            for (near, candidate) in nearest.iter_mut().zip(&candidates) {
                *near = near.min(distance(lab, candidate.1));
            }
            rgb
        })
        .collect()
}

/// Oklab (Ottosson 2020) of a colour, with a square for the display's gamma: exact arithmetic, near enough to compare.
fn oklab(rgb: [u8; 3]) -> [f32; 3] {
    let [r, g, b] = rgb.map(|c| (f32::from(c) / 255.0) * (f32::from(c) / 255.0));
    let l = cube_root(0.412_221_46 * r + 0.536_332_55 * g + 0.051_445_995 * b);
    let m = cube_root(0.211_903_5 * r + 0.680_699_5 * g + 0.107_396_96 * b);
    let s = cube_root(0.088_302_46 * r + 0.281_718_85 * g + 0.629_978_7 * b);
    [
        0.210_454_26 * l + 0.793_617_8 * m - 0.004_072_047 * s,
        1.977_998_5 * l - 2.428_592_2 * m + 0.450_593_7 * s,
        0.025_904_037 * l + 0.782_771_77 * m - 0.808_675_77 * s,
    ]
}

/// Newton's iteration for 0 <= x <= 1, in the same bits everywhere.
fn cube_root(x: f32) -> f32 {
    if x <= 0.0 {
        return 0.0;
    }
    (0..24).fold(1.0f32, |y, _| (2.0 * y + x / (y * y)) / 3.0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::BTreeSet;

    #[test]
    fn every_class_count_has_its_names_and_distinct_colours() {
        for classes in 2..=256 {
            let palette = Palette::of(classes);
            assert_eq!(palette.classes().len(), classes);
            let colours: BTreeSet<_> = palette.classes().iter().map(|c| c.rgb).collect();
            assert_eq!(colours.len(), classes, "colours repeat among {classes} classes");
            let names: BTreeSet<_> = palette.classes().iter().map(|c| &c.name).collect();
            assert_eq!(names.len(), classes);
        }
        assert_eq!(Palette::of(17).classes()[4], Class { name: "car".into(), rgb: [0, 150, 245] });
        assert_eq!(Palette::of(20).classes()[9], Class { name: "road".into(), rgb: [255, 0, 255] });
        assert_eq!(Palette::of(5).classes()[4].name, "class 4");
    }

    #[test]
    fn empty_and_unknown_classes_are_not_drawn() {
        let palette = Palette::of(17);
        let drawn: Vec<u8> = (0..=255).filter(|&c| palette.is_drawn(c)).collect();
        assert_eq!(drawn, (1..=16).collect::<Vec<u8>>());
        assert!((0..=255).all(|c| !Palette::new(Vec::new()).is_drawn(c)));
    }

    #[test]
    fn generated_colours_lie_apart() {
        let colours = separated(30);
        for (i, &a) in colours.iter().enumerate() {
            for &b in &colours[..i] {
                let (a, b) = (oklab(a), oklab(b));
                let distance: f32 = (0..3).map(|k| (a[k] - b[k]) * (a[k] - b[k])).sum();
                assert!(distance > 0.01, "{:?} and {:?}", colours[i], distance);
            }
        }
        assert!((cube_root(0.125) - 0.5).abs() < 1e-6 && cube_root(0.0) == 0.0);
    }
}
