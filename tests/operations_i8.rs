//! Every kernel of 8-bit tensors against the reference's results for single operations (docs/reference.md), on every
//! instruction set: equal, without any tolerance.

use safetensors::SafeTensors;
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;
use voxcast::Isa;
use voxcast_kernels::LANES;
use voxcast_kernels::cases::isas;
use voxcast_kernels::conv::Geometry;
use voxcast_kernels::conv_i8::{ConvI8, conv_i8, conv_i8_wide};
use voxcast_kernels::deconv3d::kernel_tap;
use voxcast_kernels::deconv3d_i8::{Deconv3dI8, deconv3d_i8};
use voxcast_kernels::deform_conv2d_i8::{DeformConv2dI8, deform_conv2d_i8};
use voxcast_kernels::depthwise::Depthwise;
use voxcast_kernels::depthwise_i8::{DepthwiseI8, depthwise_i8};
use voxcast_kernels::dequantise::dequantise;
use voxcast_kernels::gate_i8::{self, GateI8, gate_i8};
use voxcast_kernels::gather::Gather;
use voxcast_kernels::gather_i8::{self, gather_i8};
use voxcast_kernels::head::Results;
use voxcast_kernels::head_i8::{HeadI8, LayerI8, head_i8};
use voxcast_kernels::max_pool::MaxPool;
use voxcast_kernels::max_pool_i8::max_pool_i8;
use voxcast_kernels::mean_i8::{self, mean_i8};
use voxcast_kernels::normalise_i8::{self, NormaliseI8, normalise_i8};
use voxcast_kernels::panels::packed_len;
use voxcast_kernels::pool::{Mean, broadcast};
use voxcast_kernels::product::int8::{layout, scratch_len};
use voxcast_kernels::product::{ProductI8, ResidualI8};
use voxcast_kernels::quantise::quantise;
use voxcast_kernels::upsample_add::UpsampleAdd;
use voxcast_kernels::upsample_add_i8::upsample_add_i8;

#[path = "support/named.rs"]
mod named;
#[path = "support/operations_i8.rs"]
mod table;

use table::{After, Case, Columns, Kind, table};

/// What outputs hold before a call.
const JUNK: i8 = 55;

/// What a case runs with.
#[derive(Clone, Copy)]
struct Run<'a> {
    case: &'a Case,
    isa: Isa,
}

/// A product's right side.
struct Right {
    depth: usize,
    outputs: usize,
    after: After,
    weights: Vec<i8>,
    sums: Vec<i32>,
    pairs: Vec<u8>,
    columns: Columns,
}

impl Right {
    /// The weights `weight(k, n)`.
    fn new(
        [depth, outputs]: [usize; 2],
        after: After,
        mut columns: Columns,
        weight: impl Fn(usize, usize) -> i32,
    ) -> Self {
        let mut weights = vec![JUNK; packed_len(depth, outputs)];
        layout::pack(depth, outputs, |k, n| weight(k, n) as i8, &mut weights);
        for numbers in [&mut columns.bias, &mut columns.multiplier, &mut columns.residual] {
            *numbers = padded(numbers);
        }
        let residual = after.adds().then_some(&columns.residual[..]);
        assert_eq!(layout::fits(&weights, depth, outputs, &columns.bias, residual), Ok(()), "sums leave 32 bits");
        let (sums, pairs) = (layout::sums(&weights, depth).collect(), layout::pairs(&weights, depth).collect());
        Self { depth, outputs, after, weights, sums, pairs, columns }
    }

    fn product<'a>(&'a self, signed: bool, residual: &'a [i8]) -> ProductI8<'a> {
        let Columns { bias, multiplier, residual: joins } = &self.columns;
        ProductI8 {
            weights: &self.weights,
            sums: &self.sums,
            pairs: &self.pairs,
            bias,
            depth: self.depth,
            columns: self.outputs,
            signed,
            relu: self.after.relu(),
            residual: match self.after {
                After::Nothing | After::Relu => ResidualI8::None,
                After::AddRelu | After::ReluAdd => ResidualI8::Apart {
                    rows: residual,
                    stride: self.outputs,
                    multiplier: joins,
                    after: self.after == After::ReluAdd,
                },
            },
            multiplier,
        }
    }

    fn scratch(&self) -> Vec<i32> {
        vec![JUNK.into(); scratch_len(self.depth, self.outputs)]
    }
}

impl Run<'_> {
    /// Positions with their channels.
    fn rows(&self, what: &str, positions: usize, channels: usize, signed: bool) -> Vec<i8> {
        bytes(&channels_last(&self.case.elements(what, positions * channels, signed), channels))
    }

    fn result(&self) -> Vec<i32> {
        let (case, isa) = (self.case, self.isa);
        match case.kind {
            Kind::Normalise { height, width } => {
                let [rows, columns] = [height, width].map(|v| v.next_multiple_of(32));
                let args = NormaliseI8 {
                    factors: three(&case.integers("factors", 3, normalise_i8::MAX_FACTOR, false)),
                    offsets: three(&case.integers("offsets", 3, normalise_i8::MAX_OFFSET, true)),
                };
                let mut out = vec![JUNK; rows * columns * 3];
                normalise_i8(&args, &case.bytes(height * width * 3), [height, width], columns, 0, &mut out);
                channels_first(&out, 3)
            }
            Kind::Conv(conv) => self.conv(&conv),
            Kind::DeformConv { .. } => self.deform_conv(),
            Kind::Deconv { .. } => self.deconv(),
            Kind::Head { voxels, channels, classes } => self.head(voxels, channels, classes),
            Kind::Depthwise { height, width, channels, side, residual } => {
                self.depthwise([height, width], channels, side, residual)
            }
            Kind::MaxPool { height, width, channels } => {
                let input = self.rows("x", height * width, channels, true);
                let args = MaxPool { input: &input[..], height, width, channels, kernel: 3, stride: 2, padding: 1 };
                let [rows, columns] = args.output();
                let mut out = vec![JUNK; rows * columns * channels];
                max_pool_i8(isa, &args, 0..rows, &mut out);
                channels_first(&out, channels)
            }
            Kind::UpsampleAdd { low: [low_height, low_width], size: [height, width], channels } => {
                let low = self.rows("low", low_height * low_width, channels, true);
                let args = UpsampleAdd { low: &low[..], low_height, low_width, height, width, channels };
                let factors = case.integers("factors", 2, i16::MAX.into(), false);
                let mut out = self.rows("x", height * width, channels, true);
                upsample_add_i8(isa, &args, [factors[0] as i16, factors[1] as i16], 0..height, &mut out);
                channels_first(&out, channels)
            }
            Kind::Gather { rows, cameras, pixels, channels, ends } => {
                self.gather(rows, [cameras, pixels, channels], ends)
            }
            Kind::Gate { columns: [x, y], depth, channels } => {
                let columns = case.columns("columns", channels, 1);
                let factor = |what, high| case.integers(what, 1, high, false)[0];
                let [own, other] = gate_i8::MAX_FACTORS;
                let args = GateI8 {
                    bev: &self.rows("bev", x * y, channels, true),
                    depth,
                    channels,
                    weights: &padded(&bytes(&case.elements("weight", channels, true))),
                    bias: columns.bias[0],
                    multiplier: columns.multiplier[0],
                    factors: [factor("own factor", own), factor("bev factor", other)],
                };
                let mut out = self.rows("volume", x * y * depth, channels, true);
                gate_i8(isa, &args, &mut out);
                channels_first(&out, channels)
            }
            Kind::GlobalMean { positions, channels } => {
                let factor = case.integers("factor", 1, mean_i8::MAX_FACTOR, false)[0];
                let input = self.rows("x", positions, channels, true);
                let mut out = vec![JUNK; channels];
                mean_i8(isa, &Mean { input: &input[..], channels }, factor, &mut out);
                channels_first(&out, channels)
            }
            Kind::Broadcast { positions, channels } => {
                let mut out = vec![JUNK; positions * channels];
                broadcast(&bytes(&case.elements("x", channels, true)), channels, 0, &mut out);
                channels_first(&out, channels)
            }
            Kind::Quantise { len } => {
                let mut out = vec![JUNK; len];
                quantise(isa, &case.numbers("x", len), 64.0, &mut out);
                channels_first(&out, 1)
            }
            Kind::Dequantise { len } => {
                let mut out = vec![f32::NAN; len];
                dequantise(isa, &bytes(&case.elements("x", len, true)), 0.037, &mut out);
                out.iter().map(|v| v.to_bits().cast_signed()).collect()
            }
        }
    }

    fn conv(&self, shape: &table::Conv) -> Vec<i32> {
        let table::Conv { extent, inputs, outputs, kernel, signed, wide, after, .. } = *shape;
        let ((stride, dilation, padding), output) = (shape.axes(), shape.output());
        let geometry = Geometry { input: extent, channels: inputs, kernel, stride, dilation, padding, output };
        let (positions, depth) = (geometry.rows(), geometry.depth());
        let right = self.right([depth, outputs], after, inputs);
        let residual = self.residual(after, positions, outputs);
        let args = ConvI8 {
            geometry,
            input: &self.rows("x", extent.iter().product(), inputs, signed),
            product: right.product(signed, &residual),
        };
        if wide {
            let mut out = vec![i32::from(JUNK); positions * outputs];
            conv_i8_wide(self.isa, &args, 0..positions, outputs, &mut out, &mut right.scratch());
            return channels_last(&out, positions);
        }
        let mut out = vec![JUNK; positions * outputs];
        conv_i8(self.isa, &args, 0..positions, outputs, &mut out, &mut right.scratch());
        channels_first(&out, outputs)
    }

    fn deform_conv(&self) -> Vec<i32> {
        let Kind::DeformConv { height, width, inputs, outputs, reach, after } = self.case.kind else { unreachable!() };
        let (extent, positions) = ([1, height, width], height * width);
        let geometry = Geometry {
            input: extent,
            channels: inputs,
            kernel: [1, 3, 3],
            stride: [1; 3],
            dilation: [1; 3],
            padding: [0, 1, 1],
            output: extent,
        };
        let right = self.right([geometry.depth(), outputs], after, inputs);
        let residual = self.residual(after, positions, outputs);
        let args = DeformConv2dI8 {
            geometry,
            input: &self.rows("x", positions, inputs, true),
            offsets: &channels_last(&self.case.offsets(positions, reach), 27),
            product: right.product(true, &residual),
        };
        let mut out = vec![JUNK; positions * outputs];
        deform_conv2d_i8(self.isa, &args, 0..positions, outputs, &mut out, &mut right.scratch());
        channels_first(&out, outputs)
    }

    fn deconv(&self) -> Vec<i32> {
        let Kind::Deconv { extent, inputs, outputs, after } = self.case.kind else { unreachable!() };
        let (depth, weight) = (8 * inputs, self.case.elements("weight", inputs * outputs * 64, true));
        let parity = |parity: usize| {
            Right::new([depth, outputs], after, self.case.columns("columns", depth, outputs), |k, n| {
                let (tap, c) = (k / inputs, k % inputs);
                let bits = |v: usize| [v >> 2 & 1, v >> 1 & 1, v & 1];
                let axes = bits(parity).into_iter().zip(bits(tap));
                weight[axes.fold(c * outputs + n, |at, (parity, tap)| at * 4 + kernel_tap(parity, tap))]
            })
        };
        let parities: Vec<Right> = (0..8).map(parity).collect();
        let Columns { bias, multiplier, residual: joins } = &parities[0].columns;
        let positions = 8 * extent.iter().product::<usize>();
        let residual = self.residual(after, positions, outputs);
        let args = Deconv3dI8 {
            extent,
            channels: inputs,
            columns: outputs,
            input: &self.rows("x", positions / 8, inputs, true),
            signed: true,
            weights: &parities.iter().flat_map(|p| p.weights.clone()).collect::<Vec<_>>(),
            sums: &parities.iter().flat_map(|p| p.sums.clone()).collect::<Vec<_>>(),
            pairs: &parities.iter().flat_map(|p| p.pairs.clone()).collect::<Vec<_>>(),
            bias,
            relu: after.relu(),
            add: after.adds().then_some((&residual[..], &joins[..])),
            multiplier,
        };
        let mut out = vec![JUNK; positions * outputs];
        deconv3d_i8(self.isa, &args, 0..2 * extent[0], &mut out, &mut parities[0].scratch());
        channels_first(&out, outputs)
    }

    /// The logits, as sums, and the classes.
    fn head(&self, voxels: usize, channels: usize, classes: usize) -> Vec<i32> {
        let layer = |i: usize, outputs: usize| {
            let weight = self.case.elements(&format!("{i}.weight"), outputs * channels, true);
            let columns = self.case.columns(&format!("{i}.columns"), channels, outputs);
            Right::new([channels, outputs], After::Relu, columns, |k, n| weight[n * channels + k])
        };
        let layers = [layer(0, channels), layer(1, channels), layer(2, classes)];
        let args = HeadI8 {
            input: &self.rows("x", voxels, channels, true),
            signed: true,
            channels,
            classes,
            layers: layers.each_ref().map(|right| LayerI8 {
                weights: &right.weights,
                sums: &right.sums,
                pairs: &right.pairs,
                bias: &right.columns.bias,
            }),
            multipliers: [0, 1].map(|i| &layers[i].columns.multiplier[..]),
            // Logits that are the sums, to 24 bits.
            scale: 1.0,
        };
        let (mut found, mut logits) = (vec![0; voxels], vec![f32::NAN; voxels * classes]);
        let mut scratch = vec![JUNK.into(); voxcast_kernels::head_i8::scratch_len(channels, classes)];
        let results = Results { classes: &mut found, logits: Some(&mut logits), confidence: None };
        head_i8(self.isa, &args, 0..voxels, results, &mut scratch);
        logits.iter().map(|&logit| logit as i32).chain(found.into_iter().map(i32::from)).collect()
    }

    /// Weights `[outputs, inputs, taps]`, with k over (tap, input).
    fn right(&self, [depth, outputs]: [usize; 2], after: After, inputs: usize) -> Right {
        let (weight, taps) = (self.case.elements("weight", outputs * depth, true), depth / inputs);
        let columns = self.case.columns("columns", depth, outputs);
        Right::new([depth, outputs], after, columns, |k, n| weight[n * depth + k % inputs * taps + k / inputs])
    }

    fn residual(&self, after: After, positions: usize, outputs: usize) -> Vec<i8> {
        if after.adds() { self.rows("residual", positions, outputs, true) } else { vec![] }
    }

    fn depthwise(&self, [height, width]: [usize; 2], channels: usize, side: usize, residual: bool) -> Vec<i32> {
        let weight = bytes(&channels_last(&self.case.elements("weight", channels * side * side, true), channels));
        let columns = self.case.columns("columns", side * side, channels);
        let args = DepthwiseI8 {
            convolution: Depthwise {
                input: &self.rows("x", height * width, channels, true),
                height,
                width,
                channels,
                kernel: side,
                weights: &weight.chunks_exact(channels).flat_map(padded).collect::<Vec<_>>(),
                bias: &padded(&columns.bias),
                residual,
            },
            residual: &if residual { padded(&columns.residual) } else { vec![] },
            multiplier: &padded(&columns.multiplier),
        };
        let mut out = vec![JUNK; height * width * channels];
        depthwise_i8(self.isa, &args, 0..height, &mut out);
        channels_first(&out, channels)
    }

    fn gather(&self, rows: &[usize], [cameras, pixels, channels]: [usize; 3], ends: bool) -> Vec<i32> {
        let case = self.case;
        let (ptr, col) = case.matrix(rows, cameras * pixels);
        let features: Vec<i8> =
            (0..cameras).flat_map(|i| self.rows(&format!("camera {i}"), pixels, channels, true)).collect();
        let bias = ends.then(|| case.integers("bias", channels, gather_i8::MAX_BIAS, true));
        let args = Gather {
            ptr: &ptr,
            col: &col,
            mask: None,
            features: &features[..],
            stride: channels,
            first_channel: 0,
            channels,
            bias: bias.as_deref(),
            relu: ends,
        };
        let factor = case.integers("factor", 1, gather_i8::MAX_FACTOR, false)[0];
        let mut out = vec![JUNK; rows.len() * channels];
        gather_i8(self.isa, &args, factor, 0..rows.len(), &mut out);
        channels_first(&out, channels)
    }
}

fn bytes(values: &[i32]) -> Vec<i8> {
    values.iter().map(|&v| i8::try_from(v).expect("8 bits")).collect()
}

fn three(values: &[i32]) -> [i32; 3] {
    values.try_into().expect("three")
}

fn padded<T: Copy + Default>(values: &[T]) -> Vec<T> {
    let mut out = values.to_vec();
    out.resize(values.len().next_multiple_of(LANES), T::default());
    out
}

/// `[channels, positions]` to `[positions, channels]`.
fn channels_last(values: &[i32], channels: usize) -> Vec<i32> {
    let positions = values.len() / channels;
    (0..values.len()).map(|i| values[i % channels * positions + i / channels]).collect()
}

/// `[positions, channels]` to `[channels, positions]`.
fn channels_first(values: &[i8], channels: usize) -> Vec<i32> {
    let values: Vec<i32> = values.iter().copied().map(i32::from).collect();
    channels_last(&values, values.len() / channels)
}

/// Results of the reference by name.
fn expected() -> BTreeMap<String, Vec<i32>> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/golden/reference/operations_i8.safetensors");
    let bytes = std::fs::read(path).unwrap();
    let file = SafeTensors::deserialize(&bytes).unwrap();
    let values = |data: &[u8]| data.as_chunks().0.iter().map(|&b| i32::from_le_bytes(b)).collect();
    file.iter().map(|(name, tensor)| (name.to_owned(), values(tensor.data()))).collect()
}

#[test]
fn kernels_equal_the_reference() {
    let (expected, table) = (expected(), table());
    for case in &table {
        let mut want = expected[&case.name].clone();
        if matches!(case.kind, Kind::Head { .. }) {
            // Logits are the nearest f32 to sums.
            want.iter_mut().for_each(|v| *v = *v as f32 as i32);
        }
        for isa in isas() {
            let found = Run { case, isa }.result();
            assert_eq!(found.len(), want.len(), "{}", case.name);
            let differ = found.iter().zip(&want).filter(|(a, b)| a != b).count();
            let first = found.iter().zip(&want).position(|(a, b)| a != b);
            let pair = first.map(|i| (i, found[i], want[i]));
            assert_eq!(pair, None, "{} on {}: {differ} of {} differ", case.name, isa.name(), want.len());
        }
    }
    let names: BTreeSet<&String> = expected.keys().collect();
    assert_eq!(names.len(), table.len(), "names are unique");
    assert_eq!(names, table.iter().map(|case| &case.name).collect(), "every expected result is compared");
}

/// Results that were all alike, or mostly at an end, would show little.
#[test]
fn expected_results_are_lively() {
    let expected = expected();
    for case in table() {
        let (name, values) = (&case.name, &expected[&case.name]);
        let different: BTreeSet<i32> = values.iter().copied().collect();
        let inside = values.iter().filter(|v| (-126..=126).contains(*v)).count();
        let (least, share) = match (&case.kind, name.ends_with(".ends")) {
            (Kind::Broadcast { .. }, _) => (1, 0),
            (_, true) => (2, 0),
            // Sums and the bits of numbers.
            (Kind::Head { .. } | Kind::Dequantise { .. }, false) => (10, 0),
            (_, false) => (3, 8),
        };
        assert!(different.len() >= least, "{name}: {} different results", different.len());
        assert!(share == 0 || share * inside >= values.len(), "{name}: {inside} of {} results inside", values.len());
    }
}
