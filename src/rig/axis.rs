//! Coordinates of the sample points along one axis.

use crate::network::Sampling;

/// The `points` sample coordinates of an axis over `[lo, hi]` metres; point i lies in voxel i / samples.
pub(super) fn axis(sampling: Sampling, [lo, hi]: [f32; 2], points: usize) -> Vec<f32> {
    match sampling {
        Sampling::Linspace => linspace(lo, hi, points),
        Sampling::Centres => centres(lo, hi, points),
    }
}

/// `points` values from `lo` to `hi` inclusive, with the bits of `torch.linspace` in f32 on a CPU: the step is rounded
/// once, the first half counts up from `lo` and the rest down from `hi`, each with one fused multiply-add.
fn linspace(lo: f32, hi: f32, points: usize) -> Vec<f32> {
    if points == 1 {
        return vec![lo];
    }
    let step = (hi - lo) / (points - 1) as f32;
    (0..points)
        .map(|i| if i < points / 2 { step.mul_add(i as f32, lo) } else { (-step).mul_add((points - 1 - i) as f32, hi) })
        .collect()
}

/// Centres of `points` equal cells, computed in f64 and rounded once.
fn centres(lo: f32, hi: f32, points: usize) -> Vec<f32> {
    let (lo, hi) = (f64::from(lo), f64::from(hi));
    (0..points).map(|i| (lo + (i as f64 + 0.5) * (hi - lo) / points as f64) as f32).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::network::Network;
    use xxhash_rust::xxh3::xxh3_64;

    /// Bits of `torch.linspace(lo, hi, points)`, PyTorch 2.15 on an x86-64 CPU.
    const TORCH: &[([f32; 2], usize, &[u32])] = &[
        (
            [-50.0, 50.0],
            12,
            &[
                0xc2480000, 0xc223a2e9, 0xc1fe8ba3, 0xc1b5d174, 0xc15a2e8c, 0xc091745e, 0x4091745e, 0x415a2e8c,
                0x41b5d174, 0x41fe8ba3, 0x4223a2e9, 0x42480000,
            ],
        ),
        (
            [0.0, 51.2],
            9,
            &[
                0x00000000, 0x40cccccd, 0x414ccccd, 0x4199999a, 0x41cccccd, 0x42000000, 0x4219999a, 0x42333333,
                0x424ccccd,
            ],
        ),
        (
            [-25.6, 25.6],
            17,
            &[
                0xc1cccccd, 0xc1b33333, 0xc199999a, 0xc1800000, 0xc14ccccd, 0xc119999a, 0xc0cccccd, 0xc04ccccd,
                0x00000000, 0x404ccccd, 0x40cccccd, 0x4119999a, 0x414ccccd, 0x41800000, 0x4199999a, 0x41b33333,
                0x41cccccd,
            ],
        ),
        (
            [-2.0, 4.4],
            11,
            &[
                0xc0000000, 0xbfae147b, 0xbf3851ec, 0xbda3d710, 0x3f0f5c28, 0x3f99999b, 0x3feb8520, 0x401eb852,
                0x4047ae15, 0x4070a3d8, 0x408ccccd,
            ],
        ),
        (
            [-5.0, 3.0],
            20,
            &[
                0xc0a00000, 0xc09286bd, 0xc0850d79, 0xc06f286c, 0xc05435e5, 0xc039435e, 0xc01e50d8, 0xc0035e51,
                0xbfd0d794, 0xbf9af286, 0xbf4a1af3, 0xbebca1b0, 0x3d579430, 0x3ef286bc, 0x3f650d79, 0x3fa86bca,
                0x3fde50d8, 0x400a1af2, 0x40250d79, 0x40400000,
            ],
        ),
        ([-5.0, 3.0], 1, &[0xc0a00000]),
    ];

    /// XXH3-64 of the little-endian bytes of `torch.linspace(lo, hi, points)`, from the same source.
    const TORCH_DIGESTS: &[([f32; 2], usize, u64)] = &[
        ([-50.0, 50.0], 400, 0x608c_4304_b791_1cf1),
        ([-5.0, 3.0], 32, 0x9561_042a_ced7_0402),
        ([-50.0, 50.0], 250, 0x787f_5523_3629_95a7),
        ([-5.0, 3.0], 20, 0x9860_1890_7460_e2f8),
        ([-50.0, 50.0], 150, 0xaa4a_480e_697f_b08d),
        ([-5.0, 3.0], 12, 0x996c_6de1_7fbc_dd1e),
        ([-50.0, 50.0], 384, 0x34ae_d9ac_9338_a22d),
        ([-5.0, 3.0], 48, 0xd10a_df0b_0022_77a1),
        ([-50.0, 50.0], 256, 0x7c43_061d_d610_8455),
        ([-50.0, 50.0], 160, 0xb8b7_a7c0_a711_5973),
        ([0.0, 51.2], 384, 0x9cc8_ae58_ab47_576a),
        ([-25.6, 25.6], 384, 0x5e74_f919_38d7_2435),
        ([-2.0, 4.4], 48, 0x0337_2203_0f1e_cab6),
        ([0.0, 51.2], 256, 0x80e0_e96d_1c33_9768),
        ([-25.6, 25.6], 256, 0x3ed4_639d_024c_a4db),
        ([-2.0, 4.4], 32, 0x2bad_7c92_1086_aff1),
        ([0.0, 51.2], 160, 0x5590_f550_5309_75df),
        ([-25.6, 25.6], 160, 0xd4cb_dab3_6615_b2d6),
        ([-2.0, 4.4], 20, 0x75ab_e239_2551_30c4),
        ([-50.0, 50.0], 208, 0x23b8_5666_cd4a_f2b6),
        ([-5.3, 2.7], 16, 0xeade_a3e6_4512_5c9e),
        ([-50.0, 50.0], 130, 0x6785_f285_bec8_ace0),
        ([-5.3, 2.7], 10, 0x9987_c701_c752_baeb),
        ([-50.0, 50.0], 78, 0xcfd4_89bd_d495_2915),
        ([-5.3, 2.7], 6, 0xa20d_28a5_b0af_386c),
    ];

    #[test]
    fn linspace_has_the_bits_of_torch() {
        for (bounds, points, expected) in TORCH {
            let found: Vec<u32> = linspace(bounds[0], bounds[1], *points).iter().map(|v| v.to_bits()).collect();
            assert_eq!(found, *expected, "linspace({bounds:?}, {points})");
        }
    }

    #[test]
    fn linspace_of_every_built_in_axis_has_the_bits_of_torch() {
        let mut checked = 0;
        for name in crate::network::BUILT_IN {
            let network = Network::built_in(name).unwrap();
            for (grid, samples) in network.grids.iter().zip(network.samples) {
                for (voxels, bounds) in grid.iter().zip(network.bounds) {
                    let points = voxels * samples;
                    let (.., expected) = TORCH_DIGESTS
                        .iter()
                        .find(|(b, n, _)| (*b, *n) == (bounds, points))
                        .expect("a digest of each axis");
                    let bytes: Vec<u8> =
                        linspace(bounds[0], bounds[1], points).iter().flat_map(|v| v.to_le_bytes()).collect();
                    assert_eq!(xxh3_64(&bytes), *expected, "linspace({bounds:?}, {points})");
                    checked += 1;
                }
            }
        }
        assert_eq!(checked, 36);
    }

    #[test]
    fn centres_by_hand() {
        assert_eq!(centres(0.0, 8.0, 4), [1.0, 3.0, 5.0, 7.0]);
        assert_eq!(centres(-1.0, 1.0, 1), [0.0]);
        // 0.1 in f32 is 0.100000001490116; its half, rounded once, is the f32 of half that.
        assert_eq!(centres(0.0, 0.1, 1), [0.05]);
    }

    #[test]
    fn linspace_by_hand() {
        assert_eq!(linspace(-2.0, 2.0, 5), [-2.0, -1.0, 0.0, 1.0, 2.0]);
        assert_eq!(linspace(3.0, 4.0, 1), [3.0]);
        assert_eq!(linspace(3.0, 4.0, 2), [3.0, 4.0]);
    }

    #[test]
    fn axis_follows_the_sampling() {
        assert_eq!(axis(Sampling::Linspace, [0.0, 4.0], 2), [0.0, 4.0]);
        assert_eq!(axis(Sampling::Centres, [0.0, 4.0], 2), [1.0, 3.0]);
    }
}
