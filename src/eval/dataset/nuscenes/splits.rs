//! Which scenes of nuScenes are for what.

/// Numbers of the scenes of the official `val` split, as first and last of runs.
const VAL: [(u16, u16); 26] = [
    (3, 3),
    (12, 18),
    (35, 36),
    (38, 39),
    (92, 110),
    (221, 221),
    (268, 278),
    (329, 332),
    (344, 346),
    (519, 524),
    (552, 565),
    (625, 627),
    (629, 630),
    (632, 638),
    (770, 771),
    (775, 775),
    (777, 778),
    (780, 784),
    (794, 800),
    (802, 802),
    (904, 917),
    (919, 931),
    (962, 963),
    (966, 969),
    (971, 972),
    (1059, 1073),
];

/// Whether `scene`, such as `scene-0003`, belongs to the official `val` split. The other scenes of `v1.0-trainval` are
/// `train`.
pub(super) fn is_val(scene: &str) -> bool {
    let digits = scene.strip_prefix("scene-").filter(|d| d.len() == 4 && d.bytes().all(|b| b.is_ascii_digit()));
    let number = digits.and_then(|digits| digits.parse().ok());
    number.is_some_and(|number: u16| VAL.iter().any(|&(first, last)| (first..=last).contains(&number)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_hundred_and_fifty_scenes() {
        let val: Vec<u16> = (0..=9999).filter(|number| is_val(&format!("scene-{number:04}"))).collect();
        assert_eq!((val.len(), val[0], val[149]), (150, 3, 1073));
        // Digest of the official list: sums of the numbers and of their squares.
        let sum = |power: u32| val.iter().map(|&n| u64::from(n).pow(power)).sum::<u64>();
        assert_eq!((sum(1), sum(2)), (88_948, 71_058_234));
        for other in ["scene-3", "scene-00003", "0003", "scene-+003", ""] {
            assert!(!is_val(other), "{other}");
        }
    }
}
