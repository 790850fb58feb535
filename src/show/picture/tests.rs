use super::*;
use proptest::prelude::*;

const BOUNDS: [[f32; 2]; 3] = [[-8.0, 8.0], [-8.0, 8.0], [-2.0, 2.0]];

fn image(height: usize, width: usize, seed: usize) -> Image {
    Image { height, width, bgr: (0..height * width * 3).map(|i| (i * 7 + seed * 31) as u8).collect() }
}

fn occupancy(classes: &[u8], grid: [usize; 3]) -> Occupancy<'_> {
    Occupancy::new("test", classes, Grid::new(grid, BOUNDS), [0.0, 1.0]).unwrap()
}

fn figure_of(images: &[(&str, &Image)], occupancies: &[Occupancy<'_>], classes: usize) -> Picture {
    let palette = Palette::of(classes);
    draw(&Figure { title: "Title", subtitle: "a subtitle", images, occupancies, palette: &palette })
}

fn digest(picture: &Picture) -> u64 {
    xxhash_rust::xxh3::xxh3_64(&picture.rgb)
}

#[test]
fn equal_figures_give_equal_bytes_and_others_do_not() {
    let front = image(9, 16, 1);
    let mut classes = vec![0u8; 16 * 16 * 4];
    classes.iter_mut().step_by(5).zip((1..17).cycle()).for_each(|(c, k)| *c = k);
    let first = figure_of(&[("CAM_FRONT", &front)], &[occupancy(&classes, [16, 16, 4])], 17);
    let again = figure_of(&[("CAM_FRONT", &front)], &[occupancy(&classes, [16, 16, 4])], 17);
    assert_eq!(digest(&first), digest(&again));
    assert_eq!(first.rgb.len(), first.width * first.height * 3);
    classes[0] = 3;
    let other = figure_of(&[("CAM_FRONT", &front)], &[occupancy(&classes, [16, 16, 4])], 17);
    assert_ne!(digest(&first), digest(&other));
}

#[test]
fn occupancy_that_is_none_is_refused() {
    let new = |n: usize, grid, bounds, forward| {
        Occupancy::new("", &[1; 8][..n], Grid::new(grid, bounds), forward).map_err(|e| e.kind())
    };
    let up = [0.0, 1.0];
    assert!(new(8, [2, 2, 2], BOUNDS, [3.0, -4.0]).is_ok());
    assert_eq!(new(7, [2, 2, 2], BOUNDS, up), Err(ErrorKind::Mismatch));
    assert_eq!(new(0, [0, 2, 2], BOUNDS, up), Err(ErrorKind::Format));
    assert_eq!(new(8, [usize::MAX, 2, 2], BOUNDS, up), Err(ErrorKind::TooLarge));
    assert_eq!(new(8, [5000, 1, 1], BOUNDS, up), Err(ErrorKind::TooLarge));
    assert_eq!(new(8, [2, 2, 2], [[1.0, 1.0], BOUNDS[1], BOUNDS[2]], up), Err(ErrorKind::Format));
    assert_eq!(new(8, [2, 2, 2], [BOUNDS[0], [0.0, f32::NAN], BOUNDS[2]], up), Err(ErrorKind::Format));
    assert_eq!(new(8, [2, 2, 2], BOUNDS, [0.0, 0.0]), Err(ErrorKind::Format));
    assert_eq!(new(8, [2, 2, 2], BOUNDS, [f32::NAN, 1.0]), Err(ErrorKind::Format));
}

#[test]
fn places_that_no_camera_sees_look_otherwise() {
    let classes = vec![4u8; 90];
    let grid = [6, 5, 3];
    let blue = |picture: &Picture| picture.rgb.chunks_exact(3).filter(|p| p[2] > 150 && p[0] < 60).count();
    let all = figure_of(&[], &[occupancy(&classes, grid)], 17);
    let seen = figure_of(&[], &[occupancy(&classes, grid).with_support(&[7; 90]).unwrap()], 17);
    assert_eq!(digest(&all), digest(&seen), "seen everywhere");
    let mut support = [1; 90];
    support[45..].fill(0);
    let half = figure_of(&[], &[occupancy(&classes, grid).with_support(&support).unwrap()], 17);
    assert!((1..blue(&all) * 7 / 10).contains(&blue(&half)), "{} of {}", blue(&half), blue(&all));
    assert_eq!(occupancy(&classes, grid).with_support(&[1; 89]).unwrap_err().kind(), ErrorKind::Mismatch);
}

#[test]
fn empty_and_full_grids_and_pages_without_parts_are_drawn() {
    let grid = [6, 5, 3];
    for fill in [0u8, 4, 200] {
        let classes = vec![fill; 90];
        let picture = figure_of(&[], &[occupancy(&classes, grid)], 17);
        let blue = picture.rgb.chunks_exact(3).filter(|p| p[2] > 150 && p[0] < 60).count();
        assert_eq!(blue > 50_000, fill == 4, "{blue} blue pixels for class {fill}");
    }
    let palette = Palette::of(2);
    let bare = draw(&Figure { title: "", subtitle: "", images: &[], occupancies: &[], palette: &palette });
    assert!(bare.height > 0 && bare.width == PAGE);
    let broken = Image { height: 3, width: 3, bgr: vec![0; 5] };
    let none = Image { height: 0, width: 0, bgr: Vec::new() };
    let picture = figure_of(&[("broken", &broken), ("", &none)], &[], 17);
    assert!(picture.height > 200);
}

#[test]
fn two_occupancies_stand_below_each_other() {
    let (a, b) = (vec![4u8; 64], vec![16u8; 64]);
    let one = figure_of(&[], &[occupancy(&a, [4, 4, 4])], 17);
    let two = figure_of(&[], &[occupancy(&a, [4, 4, 4]), occupancy(&b, [4, 4, 4])], 17);
    assert!(two.height > one.height + 500);
}

#[test]
fn the_note_of_a_view_is_always_whole() {
    let fonts = Fonts::new();
    let palette = Palette::of(17);
    let classes = vec![0u8; 104 * 104 * 8];
    let support = vec![0u16; classes.len()];
    let bounds = [[-50.0, 50.0], [-50.0, 50.0], [-5.0, 2.7]];
    for (bounds, caption) in [
        (bounds, ""),
        ([[-50.0, 50.0], [-50.0, 50.0], [-5.3, 2.396]], "prediction"),
        ([[-50.1, 51.7], [-50.0, 50.0], [-5.0, 3.0]], "a rather long name of what was predicted"),
    ] {
        let occupancy = Occupancy::new(caption, &classes, Grid::new([104, 104, 8], bounds), [0.0, 1.0]).unwrap();
        let occupancy = occupancy.with_support(&support).unwrap();
        let whole = note(&occupancy, &palette);
        assert!(whole.starts_with("104 × 104 × 8 voxels of ") && whole.ends_with(" m"), "{whole}");
        for (aspect, shown) in [(1.0, 1), (4.0, 4), (0.25, 2)] {
            let (_, view) = layout::views(0, aspect, shown);
            let words = super::caption("Semantic occupancy", &occupancy);
            let note = Note::new(&fonts, &words, &occupancy, &palette, view.w as f32);
            let shown = if note.below.is_empty() { note.beside.clone() } else { note.below.join(" ") };
            assert_eq!(shown, whole);
            assert_eq!(note.beside.is_empty(), !note.below.is_empty());
            let most = note.below.iter().map(|line| fonts.width(line, NOTE_SIZE, Weight::Regular)).fold(0.0, f32::max);
            assert!(most <= view.w as f32);
        }
    }
}

#[test]
fn png_holds_the_same_pixels() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("p.png");
    let picture = Picture { width: 5, height: 3, rgb: (0..45).collect() };
    picture.write_png(&path).unwrap();
    let read = image::open(&path).unwrap().into_rgb8();
    assert_eq!((read.dimensions(), read.as_raw()), ((5, 3), &picture.rgb));
    assert!(picture.write_png(&dir.path().join("no/p.png")).is_err());
}

#[test]
fn camera_names_read_well() {
    let titles = ["CAM_FRONT_LEFT", "CAM_BACK", "image left", "CAM2", "", "camera 3"].map(camera_title);
    assert_eq!(titles, ["Front left", "Back", "image left", "Cam2", "", "camera 3"]);
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(8))]

    #[test]
    fn no_figure_panics(
        cameras in prop::sample::select(vec![0usize, 1, 2, 3, 6, 7]),
        sides in prop::array::uniform2(1usize..70),
        grid in prop::array::uniform3(1usize..9),
        seed in any::<u64>(),
        classes in 1usize..40,
        forward in prop::array::uniform2(-1.0f32..1.0),
        low in prop::array::uniform3(-90.0f32..20.0),
        size in prop::array::uniform3(0.5f32..100.0),
    ) {
        let mut random = crate::base::random::Random::new(seed);
        let cells: Vec<u8> = (0..grid.iter().product::<usize>()).map(|_| random.next_u64() as u8 % 48).collect();
        let support: Vec<u16> = cells.iter().map(|_| random.next_u64() as u16 % 3).collect();
        let images: Vec<Image> = (0..cameras).map(|k| image(sides[0] + k, sides[1], k)).collect();
        let images: Vec<(&str, &Image)> = images.iter().map(|i| ("CAM_X", i)).collect();
        let bounds = std::array::from_fn(|k| [low[k], low[k] + size[k]]);
        let occupancies: Vec<_> = Occupancy::new("any", &cells, Grid::new(grid, bounds), forward)
            .and_then(|o| if seed % 2 == 0 { o.with_support(&support) } else { Ok(o) })
            .into_iter()
            .collect();
        let picture = figure_of(&images, &occupancies, classes);
        prop_assert_eq!(picture.rgb.len(), picture.width * picture.height * 3);
    }
}
