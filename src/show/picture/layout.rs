//! Where everything stands on the page.

use super::canvas::Rect;

/// Width of the page in pixels.
pub(crate) const PAGE: usize = 2400;

/// Free space around the page's content.
pub(crate) const MARGIN: usize = 64;

/// Space between camera images.
const GUTTER: usize = 14;

/// Space between blocks.
pub(crate) const GAP: usize = 36;

/// Height of the line above a block that names it.
pub(crate) const LABEL: usize = 54;

/// Height of the map and the 3-D view when one occupancy is shown.
const VIEW: usize = 908;

/// Tallest camera cell.
const TALLEST: usize = 700;

/// Places of the camera images, in the order of the images given, and the height that they take.
pub(crate) fn cameras(names: &[&str], sizes: &[[usize; 2]], top: usize) -> (Vec<Rect>, usize) {
    let count = sizes.len();
    if count == 0 {
        return (Vec::new(), 0);
    }
    let columns = match count {
        1..=4 => count,
        5 | 6 => 3,
        7..=16 => 4,
        _ => 8,
    };
    let slots = nuscenes_slots(names).unwrap_or_else(|| (0..count).collect());
    let width = PAGE - 2 * MARGIN;
    let cell = (width - (columns - 1) * GUTTER) / columns;
    // The flattest image decides, so that a row of equal cameras has no bands; others are fitted into the cell.
    let fitted = sizes.iter().map(|&[h, w]| (cell as u128 * h as u128 / w.max(1) as u128) as usize);
    let height = fitted.max().unwrap_or(1).clamp(40, TALLEST);
    let rows = count.div_ceil(columns);
    let rects = slots.iter().zip(sizes).map(|(&slot, &size)| {
        let (row, column) = (slot / columns, slot % columns);
        // A last row that is not full stands in the middle.
        let used = if row + 1 == rows { count - row * columns } else { columns };
        let indent = (columns - used) * (cell + GUTTER) / 2;
        fit(
            Rect {
                x: MARGIN + indent + column * (cell + GUTTER),
                y: top + row * (height + GUTTER),
                w: cell,
                h: height,
            },
            size,
        )
    });
    (rects.collect(), rows * (height + GUTTER) - GUTTER)
}

/// The slots of a two-row arrangement when the names are the six of nuScenes, in any order.
fn nuscenes_slots(names: &[&str]) -> Option<Vec<usize>> {
    const SLOTS: [&str; 6] =
        ["CAM_FRONT_LEFT", "CAM_FRONT", "CAM_FRONT_RIGHT", "CAM_BACK_LEFT", "CAM_BACK", "CAM_BACK_RIGHT"];
    let slots: Option<Vec<usize>> = names.iter().map(|name| SLOTS.iter().position(|s| s == name)).collect();
    let slots = slots.filter(|s| s.len() == SLOTS.len())?;
    let mut sorted = slots.clone();
    sorted.sort_unstable();
    sorted.dedup();
    (sorted.len() == SLOTS.len()).then_some(slots)
}

/// The largest place of the proportions of `size` (height, width) in the middle of `cell`; a pixel of difference is ignored.
fn fit(cell: Rect, [height, width]: [usize; 2]) -> Rect {
    let (height, width) = (height.max(1) as u128, width.max(1) as u128);
    let tall = (cell.w as u128 * height / width).max(1) as usize;
    let wide = (cell.h as u128 * width / height).max(1) as usize;
    let (w, h) = match (tall.abs_diff(cell.h) <= 1, tall < cell.h) {
        (true, _) => (cell.w, cell.h),
        (_, true) => (cell.w, tall),
        _ => (wide.min(cell.w), cell.h),
    };
    Rect { x: cell.x + (cell.w - w) / 2, y: cell.y + (cell.h - h) / 2, w, h }
}

/// Places of the map and of the 3-D view of one occupancy of `shown`; `aspect` is the map's width over its height.
pub(crate) fn views(top: usize, aspect: f32, shown: usize) -> (Rect, Rect) {
    let width = PAGE - 2 * MARGIN;
    let height = if shown > 1 { VIEW * 4 / 5 } else { VIEW };
    let widest = width * 2 / 5;
    let map_height = if height as f32 * aspect > widest as f32 { (widest as f32 / aspect) as usize } else { height };
    let map_width = ((map_height as f32 * aspect) as usize).clamp(1, widest);
    let map = Rect { x: MARGIN, y: top + (height - map_height) / 2, w: map_width, h: map_height.max(1) };
    let x = MARGIN + map_width + GAP;
    (map, Rect { x, y: top, w: PAGE - MARGIN - x, h: height })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn six_named_cameras_stand_as_in_papers() {
        let names = ["CAM_FRONT", "CAM_FRONT_RIGHT", "CAM_FRONT_LEFT", "CAM_BACK", "CAM_BACK_LEFT", "CAM_BACK_RIGHT"];
        let (rects, height) = cameras(&names, &[[900, 1600]; 6], 100);
        let [front, front_right, front_left, back, back_left, back_right] = rects[..] else { panic!("six places") };
        assert!(front_left.x < front.x && front.x < front_right.x && front_left.y == 100 && front.y == front_right.y);
        assert!(back_left.x == front_left.x && back.x == front.x && back_right.x == front_right.x);
        assert!(back.y == front.y + front.h + GUTTER && height == 2 * front.h + GUTTER);
        assert_eq!(front_right.x + front_right.w, PAGE - MARGIN);
        let (rects, _) = cameras(&["a", "b", "c", "d", "e", "f"], &[[900, 1600]; 6], 0);
        assert!(rects.windows(2).all(|p| (p[0].y, p[0].x) < (p[1].y, p[1].x)), "given order: {rects:?}");
        assert_eq!(nuscenes_slots(&["CAM_FRONT"; 6]), None);
    }

    #[test]
    fn images_keep_their_proportions_inside_their_cells() {
        for count in 1..=64 {
            for size in [[900, 1600], [375, 1242], [1600, 900], [1, 16384], [16384, 1], [3, 3]] {
                let (rects, height) = cameras(&vec!["x"; count], &vec![size; count], 7);
                assert_eq!(rects.len(), count);
                for (i, r) in rects.iter().enumerate() {
                    assert!(r.x >= MARGIN && r.x + r.w <= PAGE - MARGIN && r.y >= 7 && r.y + r.h <= 7 + height);
                    assert!(r.w > 0 && r.h > 0);
                    let clear = |o: &Rect| r.x + r.w <= o.x || o.x + o.w <= r.x || r.y + r.h <= o.y || o.y + o.h <= r.y;
                    assert!(rects[..i].iter().all(clear), "{count} of {size:?} overlap");
                }
                let expected = size[1] as f32 / size[0] as f32;
                let r = rects[0];
                let close = (r.w as f32 - r.h as f32 * expected).abs() <= 2.0 * expected.max(1.0);
                assert!(close || r.w == 1 || r.h == 1 || r.h == 40, "{r:?} for {size:?}");
            }
        }
    }

    #[test]
    fn views_share_the_width() {
        for (aspect, shown) in [(1.0, 1), (1.0, 2), (0.25, 1), (4.0, 2)] {
            let (map, view) = views(500, aspect, shown);
            assert!(map.x == MARGIN && map.x + map.w + GAP == view.x && view.x + view.w == PAGE - MARGIN);
            assert!((map.w as f32 / map.h as f32 - aspect).abs() < 0.02 * aspect && map.y >= 500);
            assert!(map.y + map.h <= view.y + view.h && view.w > view.h);
        }
    }
}
