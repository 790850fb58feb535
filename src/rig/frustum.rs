//! A camera as the builder sees it: its projection, and which boxes it cannot see.

use super::level::LevelGrid;
use voxcast_kernels::project::{Projection, Sum};

/// A camera at one level, with the test that rules it out for boxes it cannot see.
pub(super) struct Frustum {
    pub(super) projection: Projection,
    /// Linear forms of (x, y, z, 1), none of which is negative where a sample counts: p2, p0, p1, (W - 1) p2 - p0 and
    /// (H - 1) p2 - p1.
    forms: [[f64; 4]; 5],
    /// W - 1 and H - 1.
    last: [f64; 2],
}

impl Frustum {
    pub(super) fn new(level: &LevelGrid, cameras: usize, camera: usize, m: &[f32; 16]) -> Self {
        let projection = Projection {
            matrix: std::array::from_fn(|i| m[i]),
            sum: if cameras == 1 { Sum::Pairs } else { Sum::Chain },
            width: level.image[1] as u32,
            height: level.image[0] as u32,
            stride_log2: level.stride_log2,
            base: (camera * level.pixels) as u32,
        };
        let [p0, p1, p2] = [0, 1, 2].map(|r| std::array::from_fn(|k| f64::from(m[r * 4 + k])));
        let last = [level.image[1], level.image[0]].map(|v| (v - 1) as f64);
        let less = |scale: f64, p: [f64; 4]| std::array::from_fn(|k| scale * p2[k] - p[k]);
        Self { projection, forms: [p2, p0, p1, less(last[0], p0), less(last[1], p1)], last }
    }

    /// Whether a sample in the box `[lo, hi]` per axis might count. False only if none can.
    ///
    /// A form is linear, so its largest value over the box is at a corner. With r0, r1, r2 the sums of the magnitudes
    /// that p0, p1, p2 add up, the kernel's f32 values are off by less than 1e-6 r each, a hundredth of the margin, as
    /// long as nothing overflows or underflows: beyond 1e30 nothing is ruled out, 1e-30 covers subnormal numbers, and
    /// 1e-20 r2 covers quotients that round to -0, which counts.
    pub(super) fn may_see(&self, bounds: &[[f64; 2]; 3]) -> bool {
        let reach = bounds.map(|[lo, hi]| lo.abs().max(hi.abs()));
        let sum = |form: &[f64; 4]| form[3].abs() + (0..3).map(|a| form[a].abs() * reach[a]).sum::<f64>();
        let [r2, r0, r1] = [0, 1, 2].map(|f| sum(&self.forms[f]));
        // NaN compares false here, and below: it rules nothing out.
        if !(r0 < 1e30 && r1 < 1e30 && r2 < 1e30) {
            return true;
        }
        let margins = [r2, r0 + 1e-16 * r2, r1 + 1e-16 * r2, self.last[0] * r2 + r0, self.last[1] * r2 + r1];
        !self.forms.iter().zip(margins).any(|(form, margin)| {
            let most = form[3] + (0..3).map(|a| (form[a] * bounds[a][0]).max(form[a] * bounds[a][1])).sum::<f64>();
            most < -(1e-4 * margin + 1e-30)
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::network::Network;

    fn level() -> LevelGrid {
        LevelGrid::new(&Network::built_in("nuscenes-200").unwrap(), 0)
    }

    /// Looks along x from the origin, 800 pixels of focal length.
    const AHEAD: [f32; 16] = [800., -800., 0., 0., 464., 0., -800., 0., 1., 0., 0., 0., 0., 0., 0., 1.];

    #[test]
    fn the_bounding_test_rules_out_what_is_behind_or_beside() {
        let view = Frustum::new(&level(), 6, 0, &AHEAD);
        let z = [-5.0, 3.0];
        for (x, y, expected, why) in [
            ([10.0, 11.0], [0.0, 1.0], true, "ahead"),
            ([-11.0, -10.0], [0.0, 1.0], false, "behind"),
            ([10.0, 11.0], [30.0, 31.0], false, "to the left"),
            ([10.0, 11.0], [-31.0, -30.0], false, "to the right"),
            ([10.0, 11.0], [10.5, 12.0], true, "the left edge at 45 degrees cuts the box"),
            ([-1.0, 1.0], [-1.0, 1.0], true, "around the camera"),
        ] {
            assert_eq!(view.may_see(&[x, y, z]), expected, "{why}");
        }
        assert!(!view.may_see(&[[10.0, 11.0], [0.0, 1.0], [30.0, 40.0]]), "above");
        assert!(!view.may_see(&[[10.0, 11.0], [0.0, 1.0], [-40.0, -30.0]]), "below");
    }

    #[test]
    fn the_bounding_test_rules_out_nothing_it_cannot_judge() {
        let behind = [[-11.0, -10.0], [0.0, 1.0], [-5.0, 3.0]];
        for (i, value) in [(0, f32::NAN), (5, f32::INFINITY), (8, f32::NEG_INFINITY), (2, 1e30), (11, f32::NAN)] {
            let mut m = AHEAD;
            m[i] = value;
            assert!(Frustum::new(&level(), 6, 0, &m).may_see(&behind), "{value} at {i}");
        }
    }
}
