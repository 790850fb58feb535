use super::*;
use crate::network::Grid;

const PAGE: [u8; 3] = [255; 3];

fn scene(voxels: &[([usize; 3], u8)]) -> Vec<u8> {
    let mut classes = vec![0u8; 20 * 20 * 8];
    for &([x, y, z], class) in voxels {
        classes[(x * 20 + y) * 8 + z] = class;
    }
    classes
}

/// The frame lies far from the vehicle, so that no car is drawn.
fn view(classes: &[u8]) -> Occupancy<'_> {
    Occupancy::new("", classes, Grid::new([20, 20, 8], [[100.0, 110.0], [100.0, 110.0], [0.0, 4.0]]), [0.0, 1.0])
        .unwrap()
}

fn red_pixels(rgb: &[u8], w: usize) -> Vec<[usize; 2]> {
    let red = |p: &[u8]| p[0] > 100 && p[1] < 40 && p[2] < 40;
    rgb.chunks_exact(3).enumerate().filter(|(_, p)| red(p)).map(|(i, _)| [i % w, i / w]).collect()
}

#[test]
fn voxel_lands_where_the_camera_projects_it() {
    let (w, h) = (300, 200);
    for voxel in [[3, 4, 0], [15, 2, 5], [10, 18, 7], [0, 0, 0], [19, 19, 3]] {
        let classes = scene(&[(voxel, 7)]);
        let palette = Palette::of(17);
        let rgb = render(&view(&classes), &palette, w, h, PAGE);
        let found = red_pixels(&rgb, w);
        assert!(found.len() > 20, "{voxel:?}: {} red pixels", found.len());
        let grid = Cells::new(&view(&classes), &palette);
        let camera = Viewpoint::new(&grid, grid.floor(), w * SAMPLES, h * SAMPLES);
        let middle = grid.low + grid.step * Vec3::from_array(voxel.map(|v| v as f32 + 0.5));
        let expected = camera.project(middle.as_dvec3()).map(|v| v / SAMPLES as f64);
        let mean = [0, 1].map(|k| found.iter().map(|p| p[k] as f64 + 0.5).sum::<f64>() / found.len() as f64);
        assert!((0..2).all(|k| (mean[k] - expected[k]).abs() < 2.0), "{voxel:?}: {mean:?}, expected {expected:?}");
    }
}

#[test]
fn forward_is_away_and_left_is_left() {
    let (w, h) = (300, 200);
    let palette = Palette::of(17);
    let at = |voxel: [usize; 3]| {
        let found = red_pixels(&render(&view(&scene(&[(voxel, 7)])), &palette, w, h, PAGE), w);
        [0, 1].map(|k| found.iter().map(|p| p[k]).sum::<usize>() / found.len())
    };
    let [middle, ahead, left, up] = [[10, 10, 2], [10, 17, 2], [3, 10, 2], [10, 10, 7]].map(at);
    assert!(ahead[1] < middle[1] && left[0] < middle[0], "{middle:?} {ahead:?} {left:?}");
    // A single voxel stands on the plate wherever it is; the plate is what moves.
    assert!(up[0].abs_diff(middle[0]) < 60);
}

#[test]
fn nearer_voxels_hide_those_behind() {
    let (w, h) = (300, 200);
    let palette = Palette::of(17);
    // A wall across the grid, high enough to hide what stands right behind it.
    let wall = |y: usize| (0..20).flat_map(move |x| (0..8).map(move |z| ([x, y, z], 16u8)));
    for (y, hidden) in [(9, true), (13, false)] {
        let mut voxels: Vec<_> = wall(y).collect();
        voxels.push(([10, 11, 0], 7));
        let found = red_pixels(&render(&view(&scene(&voxels)), &palette, w, h, PAGE), w);
        assert_eq!(found.is_empty(), hidden, "wall at {y}: {} red pixels", found.len());
    }
}

#[test]
fn seams_between_faces_do_not_show() {
    let (w, h) = (260, 180);
    let palette = Palette::new(vec![
        crate::show::picture::Class { name: "empty".into(), rgb: [255; 3] },
        crate::show::picture::Class { name: "floor".into(), rgb: [0, 0, 0] },
    ]);
    let floor: Vec<_> = (0..400).map(|i| ([i / 20, i % 20, 0], 1u8)).collect();
    let rgb = render(&view(&scene(&floor)), &palette, w, h, PAGE);
    // Black absorbs all light: inside the slab, any lighter pixel is a hole.
    let dark = |x: usize, y: usize| rgb[(y * w + x) * 3] == 0;
    for y in 0..h {
        let (first, last) = ((0..w).find(|&x| dark(x, y)), (0..w).rfind(|&x| dark(x, y)));
        if let (Some(first), Some(last)) = (first, last) {
            assert!((first..=last).all(|x| dark(x, y)), "hole in row {y}");
        }
    }
}

#[test]
fn shade_falls_away_from_the_sun() {
    let palette = Palette::of(17);
    let classes = scene(&[([10, 10, 0], 4), ([10, 10, 1], 4), ([10, 10, 2], 4)]);
    let grid = Cells::new(&view(&classes), &palette);
    let foot = grid.low + grid.step * Vec3::new(10.5, 10.5, 0.02);
    let beside = |x: f32, y: f32| grid.is_shaded(foot + grid.step * Vec3::new(x, y, 0.0), grid.sun);
    // The sun stands to the rear left: the shadow falls ahead and to the right.
    assert!(beside(1.0, 0.7) && !beside(-1.0, -0.7) && !beside(0.0, 3.0));
    assert!(!grid.is_shaded(foot + Vec3::Z * 5.0, grid.sun));
}

#[test]
fn sides_beyond_the_grid_are_clipped() {
    let classes = scene(&[([1, 1, 1], 4)]);
    for (w, h) in [(1, 1), (1, 300), (300, 1), (17, 33)] {
        assert_eq!(render(&view(&classes), &Palette::of(17), w, h, PAGE).len(), w * h * 3);
    }
}
