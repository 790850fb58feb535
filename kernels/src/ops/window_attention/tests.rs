use super::*;
use crate::testing::{
    Fill, Rng, assert_close, assert_lively, assert_order_shows, assert_same_bits, pad_rows, reverse_rows,
};

/// Arguments as unpacked matrices and as a kernel wants them.
struct Case {
    shape: Shape,
    input: Vec<f32>,
    /// `[heads, part, 3 * key_dim]`.
    plain_qkv: Vec<f32>,
    /// `[heads * key_dim, channels]`.
    plain_proj: Vec<f32>,
    qkv: Vec<f32>,
    qkv_bias: Vec<f32>,
    query: Vec<f32>,
    query_bias: Vec<f32>,
    offsets: Vec<f32>,
    proj: Vec<f32>,
    proj_bias: Vec<f32>,
}

/// Packs `[depth, columns]`; the zero columns become NaN, which must not show.
fn pack(depth: usize, columns: usize, w: &[f32]) -> Vec<f32> {
    let mut out = vec![0.0; packed_len(depth, columns)];
    crate::matmul::layout::pack(depth, columns, |k, n| w[k * columns + n], &mut out);
    for (n, k) in (columns..columns.next_multiple_of(LANES)).flat_map(|n| (0..depth).map(move |k| (n, k))) {
        out[crate::matmul::layout::packed_index(depth, k, n)] = f32::NAN;
    }
    out
}

impl Case {
    fn new(extent: [usize; 2], heads: usize, part: usize, key_dim: usize, seed: u64, fill: Fill) -> Self {
        let shape = Shape { extent, channels: heads * part, heads, key_dim };
        let mut rng = Rng::new(seed);
        let input = fill(&mut rng, extent[0] * extent[1] * shape.channels);
        let plain_qkv = fill(&mut rng, heads * part * 3 * key_dim);
        let plain_proj = fill(&mut rng, heads * key_dim * shape.channels);
        Self {
            shape,
            input,
            qkv: plain_qkv.chunks(part * 3 * key_dim).flat_map(|w| pack(part, 3 * key_dim, w)).collect(),
            qkv_bias: pad_rows(&fill(&mut rng, heads * 3 * key_dim), 3 * key_dim, f32::NAN),
            query: pad_rows(&fill(&mut rng, heads * 25 * key_dim), key_dim, f32::NAN),
            query_bias: pad_rows(&fill(&mut rng, heads * key_dim), key_dim, f32::NAN),
            offsets: fill(&mut rng, heads * shape.side() * shape.side()),
            proj: pack(heads * key_dim, shape.channels, &plain_proj),
            proj_bias: pad_rows(&fill(&mut rng, shape.channels), shape.channels, f32::NAN),
            plain_qkv,
            plain_proj,
        }
    }

    fn args(&self) -> WindowAttention<'_> {
        let Self { shape, input, qkv, qkv_bias, query, query_bias, offsets, proj, proj_bias, .. } = self;
        WindowAttention { shape: *shape, input, qkv, qkv_bias, query, query_bias, offsets, proj, proj_bias }
    }

    fn window_row(&self, isa: Isa, row: usize) -> Vec<f32> {
        // Neither NaN nor a large value from an earlier call may show.
        let mut rng = Rng::new(99);
        let mut junk = || [f32::NAN, 1e20, -1e20, 7.0][rng.bits() as usize % 4];
        let mut scratch: Vec<f32> = (0..self.shape.scratch_len()).map(|_| junk()).collect();
        let mut out = vec![f32::NAN; self.shape.rows(row).len() * self.shape.extent[1] * self.shape.channels];
        window_attention(isa, &self.args(), row, &mut out, &mut scratch);
        out
    }

    /// All rows of windows, the last one first.
    fn all(&self, isa: Isa) -> Vec<f32> {
        let rows: Vec<_> = (0..self.shape.window_rows()).rev().map(|row| self.window_row(isa, row)).collect();
        rows.into_iter().rev().flatten().collect()
    }

    /// The whole plane by the formula, on unpacked matrices.
    fn naive(&self) -> Vec<f64> {
        let Shape { extent: [_, extent_y], channels, .. } = self.shape;
        let ([wx, wy], x_tokens) = (self.shape.window(), self.input.len() / channels);
        let mut out: Vec<f64> = self.input.iter().map(|&v| f64::from(v)).collect();
        let windows_y = extent_y.div_ceil(wy);
        for window in 0..self.shape.window_rows() * windows_y {
            let place = |t: usize| {
                let (x, y) = (window / windows_y * wx + t / wy, window % windows_y * wy + t % wy);
                (x * extent_y + y < x_tokens && y < extent_y).then_some((x * extent_y + y) * channels)
            };
            for (t, y) in self.naive_window([wx, wy], &place).chunks(channels).enumerate() {
                if let Some(at) = place(t) {
                    y.iter().zip(&mut out[at..]).for_each(|(y, out)| *out += y);
                }
            }
        }
        out
    }

    fn naive_window(&self, [wx, wy]: [usize; 2], place: &dyn Fn(usize) -> Option<usize>) -> Vec<f64> {
        let Shape { channels, heads, key_dim, .. } = self.shape;
        let (part, tokens, side) = (self.shape.part(), wx * wy, self.shape.side());
        let (pad, pad3) = (key_dim.next_multiple_of(LANES), (3 * key_dim).next_multiple_of(LANES));
        let mut all = vec![vec![0.0; heads * key_dim]; tokens];
        let mut previous = vec![vec![0.0; part]; tokens];
        for h in 0..heads {
            let qkv: Vec<Vec<f64>> = (0..tokens)
                .map(|t| {
                    let x = |i| place(t).map_or(0.0, |at| f64::from(self.input[at + h * part + i])) + previous[t][i];
                    let w = |i, n| f64::from(self.plain_qkv[(h * part + i) * 3 * key_dim + n]);
                    let bias = |n| f64::from(self.qkv_bias[h * pad3 + n]);
                    (0..3 * key_dim).map(|n| bias(n) + (0..part).map(|i| x(i) * w(i, n)).sum::<f64>()).collect()
                })
                .collect();
            let query = |t: usize, c: usize| {
                let mut q = f64::from(self.query_bias[h * pad + c]);
                for (u, qkv) in qkv.iter().enumerate() {
                    let (dx, dy) = (u / wy + 2, u % wy + 2);
                    if (t / wy..t / wy + 5).contains(&dx) && (t % wy..t % wy + 5).contains(&dy) {
                        let tap = (dx - t / wy) * 5 + dy - t % wy;
                        q += qkv[c] * f64::from(self.query[(h * 25 + tap) * pad + c]);
                    }
                }
                q
            };
            for t in 0..tokens {
                let q: Vec<f64> = (0..key_dim).map(|c| query(t, c)).collect();
                let exps: Vec<f64> = (0..tokens)
                    .map(|u| {
                        let (dx, dy) = ((t / wy).abs_diff(u / wy), (t % wy).abs_diff(u % wy));
                        let dot: f64 = (0..key_dim).map(|c| q[c] * qkv[u][key_dim + c]).sum();
                        let offset = f64::from(self.offsets[h * side * side + dx * side + dy]);
                        (dot / (key_dim as f64).sqrt() + offset).exp()
                    })
                    .collect();
                let sum: f64 = exps.iter().sum();
                for c in 0..key_dim {
                    let y: f64 = (0..tokens).map(|u| exps[u] / sum * qkv[u][2 * key_dim + c]).sum();
                    all[t][h * key_dim + c] = y.max(0.0);
                    if heads > 1 {
                        previous[t][c] = y;
                    }
                }
            }
        }
        let proj = |t: usize, n: usize| {
            let sum: f64 =
                all[t].iter().enumerate().map(|(k, y)| y * f64::from(self.plain_proj[k * channels + n])).sum();
            sum + f64::from(self.proj_bias[n])
        };
        (0..tokens * channels).map(|i| proj(i / channels, i % channels)).collect()
    }
}

#[test]
fn by_hand() {
    // One channel, one head, two tokens with x = 1, 2. q = k = v = x, the centre tap of the 5x5 kernel is 1 and the
    // bias of q is -x0: q = 0, 1. Scores: row 0 is 0, 0 + offset; row 1 is 1 + offset, 2.
    let mut case = Case::new([1, 2], 1, 1, 1, 0, Rng::ordinary);
    case.shape.extent = [2, 1];
    case.input = vec![1.0, 2.0];
    case.qkv = pack(1, 3, &[1.0; 3]);
    case.qkv_bias = vec![0.0; 16];
    case.query = vec![0.0; 25 * 16];
    case.query[12 * 16] = 1.0;
    case.query_bias = vec![-1.0; 16];
    case.offsets = vec![0.0, 9.0, 1.0, 9.0];
    case.proj = pack(1, 1, &[10.0]);
    case.proj_bias = vec![100.0; 16];
    // Row 0: probabilities e^0 / (e^0 + e^1), e^1 / (...). Row 1: scores 1 + 1 and 2, so one half each.
    let p = 1.0 / (1.0 + 1.0f64.exp());
    let want = [1.0 + 100.0 + 10.0 * (p + 2.0 * (1.0 - p)), 2.0 + 100.0 + 10.0 * 1.5];
    for isa in Isa::available() {
        assert_close(&case.all(isa), &want, 2e-7, "two tokens");
    }
}

#[test]
fn shape_of_windows() {
    let shape = |extent| Shape { extent, channels: 64, heads: 8, key_dim: 8 };
    for (extent, side, window, rows) in [
        ([100, 100], 7, [7, 7], 15),
        ([7, 7], 7, [7, 7], 1),
        ([5, 4], 5, [5, 4], 1),
        ([4, 5], 4, [4, 4], 1),
        ([20, 3], 7, [7, 7], 3),
        ([1, 9], 1, [1, 1], 1),
    ] {
        let shape = shape(extent);
        assert_eq!((shape.side(), shape.window(), shape.window_rows()), (side, window, rows), "{extent:?}");
    }
    assert_eq!(shape([100, 100]).rows(0), 0..7);
    assert_eq!(shape([100, 100]).rows(14), 98..100);
}

/// Extent, heads, channels per head, key dimension: channels around 16, planes around 7, and the networks' own sizes.
const SHAPES: [([usize; 2], usize, usize, usize); 14] = [
    ([7, 7], 8, 8, 8),
    ([10, 8], 8, 6, 6),
    ([20, 16], 8, 4, 4),
    ([5, 4], 8, 8, 8),
    ([4, 5], 2, 3, 3),
    ([8, 7], 4, 16, 16),
    ([3, 17], 3, 5, 5),
    ([9, 15], 2, 17, 17),
    ([6, 6], 1, 16, 5),
    ([2, 3], 1, 1, 17),
    ([1, 4], 1, 33, 2),
    ([7, 14], 2, 32, 32),
    ([1, 1], 5, 1, 1),
    ([4, 4], 1, 15, 16),
];

/// [`Rng::wide`] made smaller, so that eight cascaded heads do not overflow.
fn small_and_wide(rng: &mut Rng, n: usize) -> Vec<f32> {
    rng.wide(n).into_iter().map(|x| x / 512.0).collect()
}

#[test]
fn every_isa_gives_the_scalar_bits() {
    for (extent, heads, part, key_dim) in SHAPES {
        for fill in [Rng::ordinary as Fill, small_and_wide] {
            let case = Case::new(extent, heads, part, key_dim, 21, fill);
            let want = case.all(Isa::Scalar);
            let what = format!("{extent:?}, {heads} heads of {part} and {key_dim}");
            if want.len() > 1 {
                assert_lively(&want, &what);
            }
            for isa in Isa::available() {
                assert_same_bits(&case.all(isa), &want, &format!("{isa:?} {what}"));
            }
        }
    }
}

#[test]
fn infinities_and_nan_stay_in_their_window() {
    for (value, seed) in [(f32::NAN, 1), (f32::INFINITY, 2), (f32::NEG_INFINITY, 3)] {
        let mut case = Case::new([14, 15], 2, 8, 8, seed, Rng::ordinary);
        // Row 9, column 8: window (1, 1) of 2 x 3.
        case.input[(9 * 15 + 8) * 16 + 3] = value;
        let want = case.all(Isa::Scalar);
        assert_lively(&want, &format!("{value}"));
        for (i, v) in want.iter().enumerate() {
            let (x, y) = (i / (15 * 16), i / 16 % 15);
            assert!(v.is_finite() || (x / 7, y / 7) == (1, 1), "element {i} is {v}");
        }
        assert!(want.iter().any(|v| !v.is_finite()));
        for isa in Isa::available() {
            assert_same_bits(&case.all(isa), &want, &format!("{isa:?} {value}"));
        }
    }
}

#[test]
fn extreme_scores_stay_finite() {
    // Offsets far beyond the range of exp: a softmax without its maximum would overflow.
    let mut case = Case::new([7, 7], 2, 8, 8, 5, Rng::ordinary);
    case.offsets.iter_mut().enumerate().for_each(|(i, v)| *v = (i as f32 - 49.0) * 1e4);
    let want = case.all(Isa::Scalar);
    assert!(want.iter().all(|v| v.is_finite()));
    for isa in Isa::available() {
        assert_same_bits(&case.all(isa), &want, &format!("{isa:?}"));
    }
}

#[test]
fn the_order_of_a_sum_shows() {
    for (extent, heads, part, key_dim) in [([7, 7], 2, 16, 16), ([14, 7], 1, 5, 6)] {
        let mut case = Case::new(extent, heads, part, key_dim, 7, Rng::ordinary);
        case.input.iter_mut().for_each(|x| *x *= 0.25);
        let (channels, pad) = (case.shape.channels, key_dim.next_multiple_of(LANES));
        let want = case.all(Isa::Scalar);
        // Half a turn of the plane and of the kernel on q turns the output, and the order of taps and keys.
        case.input = reverse_rows(&case.input, channels);
        case.query = case.query.chunks_exact(25 * pad).flat_map(|taps| reverse_rows(taps, pad)).collect();
        assert_order_shows(&reverse_rows(&case.all(Isa::Scalar), channels), &want, &format!("{extent:?}"));
    }
}

#[test]
fn the_scalar_code_agrees_with_f64() {
    for (extent, heads, part, key_dim) in SHAPES {
        let mut case = Case::new(extent, heads, part, key_dim, 22, Rng::ordinary);
        // Keep sums of order one, so that a tolerance means the same for every size.
        let shrink = |w: &mut Vec<f32>, depth: usize| w.iter_mut().for_each(|w| *w *= 1.0 / (depth as f32).sqrt());
        for (w, depth) in [(&mut case.plain_qkv, part), (&mut case.qkv, part), (&mut case.query, 25)] {
            shrink(w, depth);
        }
        for w in [&mut case.plain_proj, &mut case.proj] {
            shrink(w, heads * key_dim);
        }
        assert_close(&case.all(Isa::Scalar), &case.naive(), 2e-6, &format!("{extent:?} {heads} {part} {key_dim}"));
    }
}

#[test]
fn padded_tokens_take_part() {
    // With a bias on v alone and zero weights every token's output is that bias, padding or not; with the padding left
    // out of the keys it would be the same. So let the padding differ: v = x + 1, uniform probabilities.
    let mut case = Case::new([8, 7], 1, 1, 1, 0, Rng::ordinary);
    case.input = vec![6.0; 56];
    case.qkv = pack(1, 3, &[0.0, 0.0, 1.0]);
    case.qkv_bias = pad_rows(&[0.0, 0.0, 1.0], 3, 0.0);
    case.query = vec![0.0; 25 * 16];
    case.query_bias = vec![0.0; 16];
    case.offsets = vec![0.0; 49];
    case.proj = pack(1, 1, &[1.0]);
    case.proj_bias = vec![0.0; 16];
    let out = case.all(Isa::best());
    assert_close(&out[..49], &[6.0 + 7.0; 49], 1e-6, "the full window");
    // Seven tokens with v = 7 and 42 of padding with v = 1.
    assert_close(&out[49..], &[6.0 + (7.0 * 7.0 + 42.0) / 49.0; 7], 1e-6, "the padded window");
}

fn case() -> Case {
    Case::new([8, 9], 2, 3, 3, 0, Rng::ordinary)
}

#[test]
#[should_panic(expected = "an extent is zero")]
fn no_heads() {
    let case = case();
    let shape = Shape { heads: 0, ..case.shape };
    window_attention(Isa::Scalar, &WindowAttention { shape, ..case.args() }, 0, &mut [], &mut []);
}

#[test]
#[should_panic(expected = "the heads do not divide the channels")]
fn heads_that_do_not_divide() {
    let case = case();
    let shape = Shape { heads: 4, ..case.shape };
    window_attention(Isa::Scalar, &WindowAttention { shape, ..case.args() }, 0, &mut [], &mut []);
}

#[test]
#[should_panic(expected = "cascaded heads need key_dim = channels / heads")]
fn key_dim_that_does_not_cascade() {
    let case = case();
    let shape = Shape { key_dim: 2, ..case.shape };
    window_attention(Isa::Scalar, &WindowAttention { shape, ..case.args() }, 0, &mut [], &mut []);
}

type Field = fn(&mut Case) -> &mut Vec<f32>;

#[test]
fn slices_of_another_size_panic() {
    let fields: [(&str, Field); 8] = [
        ("the input has another shape", |c| &mut c.input),
        ("qkv has another shape", |c| &mut c.qkv),
        ("the bias of qkv has another length", |c| &mut c.qkv_bias),
        ("query has another shape", |c| &mut c.query),
        ("the bias of query has another length", |c| &mut c.query_bias),
        ("the offsets have another shape", |c| &mut c.offsets),
        ("proj has another shape", |c| &mut c.proj),
        ("the bias of proj has another length", |c| &mut c.proj_bias),
    ];
    for (message, field) in fields {
        let mut case = case();
        field(&mut case).pop();
        let panic = std::panic::catch_unwind(|| case.window_row(Isa::Scalar, 0)).expect_err(message);
        let text = panic.downcast_ref::<String>().expect("a formatted message");
        assert!(text.contains(message), "\"{text}\", expected \"{message}\"");
    }
}

#[test]
#[should_panic(expected = "window row 2 of 2")]
fn no_such_window_row() {
    let case = case();
    window_attention(Isa::Scalar, &case.args(), 2, &mut [], &mut vec![0.0; case.shape.scratch_len()]);
}

#[test]
#[should_panic(expected = "the scratch is too small")]
fn short_scratch() {
    let case = case();
    let mut scratch = vec![0.0; case.shape.scratch_len() - 1];
    window_attention(Isa::Scalar, &case.args(), 0, &mut [0.0; 7 * 9 * 6], &mut scratch);
}

#[test]
#[should_panic(expected = "the output is not the size of its rows")]
fn output_of_another_row() {
    let case = case();
    let mut scratch = vec![0.0; case.shape.scratch_len()];
    window_attention(Isa::Scalar, &case.args(), 1, &mut [0.0; 7 * 9 * 6], &mut scratch);
}
