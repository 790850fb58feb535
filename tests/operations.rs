//! Every kernel against the reference's results for single operations (docs/reference.md), on every instruction set, with
//! weights in both precisions.

use half::f16;
use safetensors::SafeTensors;
use std::collections::BTreeSet;
use std::fmt::Write;
use std::path::Path;
use voxcast::Isa;
use voxcast_kernels::conv::{Conv, Geometry, conv};
use voxcast_kernels::deconv3d::{Deconv3d, deconv3d, kernel_tap};
use voxcast_kernels::deform_conv2d::{DeformConv2d, deform_conv2d};
use voxcast_kernels::depthwise::{Depthwise, depthwise};
use voxcast_kernels::gate::{Gate, gate};
use voxcast_kernels::gather::{Gather, gather};
use voxcast_kernels::head::{Head, Results, head};
use voxcast_kernels::max_pool::{MaxPool, max_pool};
use voxcast_kernels::normalise::normalise;
use voxcast_kernels::panels::{pack, packed_len};
use voxcast_kernels::pool::{Mean, broadcast, mean};
use voxcast_kernels::product::{Product, Residual, SCRATCH};
use voxcast_kernels::scale_shift::{ScaleShift, scale_shift};
use voxcast_kernels::upsample_add::{UpsampleAdd, upsample_add};
use voxcast_kernels::window_attention::{Shape, WindowAttention, window_attention};
use voxcast_kernels::{LANES, Panels};

#[path = "support/named.rs"]
mod named;
#[path = "support/operations.rs"]
mod table;

use table::{After, Case, Kind, OFFSETS, QUERY_TAPS, table};

/// Packed weights in either precision.
enum Packed {
    F32(Vec<f32>),
    F16(Vec<f16>),
}

impl Packed {
    fn panels(&self) -> Panels<'_> {
        match self {
            Packed::F32(values) => Panels::F32(values),
            Packed::F16(values) => Panels::F16(values),
        }
    }
}

/// What a case runs with.
#[derive(Clone, Copy)]
struct Run<'a> {
    case: &'a Case,
    isa: Isa,
    half: bool,
}

impl Run<'_> {
    /// `weight` `[columns, inputs, taps]`, packed with k over (tap, input).
    fn packed(&self, weight: &[f32], inputs: usize, columns: usize) -> Packed {
        let depth = weight.len() / columns;
        let taps = depth / inputs;
        self.store(packed(depth, columns, |k, n| weight[n * depth + k % inputs * taps + k / inputs]))
    }

    fn store(&self, values: Vec<f32>) -> Packed {
        if !self.half {
            return Packed::F32(values);
        }
        let half: Vec<f16> = values.iter().map(|&v| f16::from_f32(v)).collect();
        assert!(values.iter().zip(&half).all(|(&v, h)| h.to_f32() == v), "weights that half precision holds exactly");
        Packed::F16(half)
    }

    fn rows(&self, what: &str, positions: usize, channels: usize) -> Vec<f32> {
        channels_last(&self.case.numbers(what, positions * channels), channels)
    }

    fn result(&self) -> Vec<f32> {
        let case = self.case;
        match case.kind {
            Kind::Normalise { height, width } => {
                let [rows, columns] = [height, width].map(|v| v.next_multiple_of(32));
                let mut out = vec![f32::NAN; rows * columns * 3];
                normalise(&case.bytes(height * width * 3), height, width, columns, 0, &mut out);
                channels_first(&out, 3)
            }
            Kind::Conv(_) => self.conv(),
            Kind::DeformConv { .. } => self.deform_conv(),
            Kind::Depthwise { height, width, channels, side } => self.depthwise([height, width], channels, side),
            Kind::BatchNorm { positions, channels, after } => self.batch_norm(positions, channels, after),
            Kind::MaxPool { height, width, channels } => {
                let input = self.rows("x", height * width, channels);
                let args = MaxPool { input: &input, height, width, channels, kernel: 3, stride: 2, padding: 1 };
                let [rows, columns] = args.output();
                let mut out = vec![f32::NAN; rows * columns * channels];
                max_pool(self.isa, &args, 0..rows, &mut out);
                channels_first(&out, channels)
            }
            Kind::UpsampleAdd { low: [low_height, low_width], size: [height, width], channels } => {
                let low = self.rows("low", low_height * low_width, channels);
                let args = UpsampleAdd { low: &low, low_height, low_width, height, width, channels };
                let mut out = self.rows("x", height * width, channels);
                upsample_add(self.isa, &args, 0..height, &mut out);
                channels_first(&out, channels)
            }
            Kind::Gather { rows, cameras, pixels, channels } => self.gather(rows, cameras, pixels, channels),
            Kind::Deconv { .. } => self.deconv(),
            Kind::WindowAttention { plane, heads, part } => self.attention(plane, heads, part),
            Kind::Gate { columns: [x, y], depth, channels } => {
                let args = Gate {
                    bev: &self.rows("bev", x * y, channels),
                    depth,
                    channels,
                    weights: &padded(&case.weights("weight", channels)),
                    bias: case.weights("bias", 1)[0],
                };
                let mut out = self.rows("volume", x * y * depth, channels);
                gate(self.isa, &args, &mut out);
                channels_first(&out, channels)
            }
            Kind::GlobalMean { positions, channels } => {
                let mut out = vec![f32::NAN; channels];
                mean(self.isa, &Mean { input: &self.rows("x", positions, channels), channels }, &mut out);
                out
            }
            Kind::Broadcast { positions, channels } => {
                let mut out = vec![f32::NAN; positions * channels];
                broadcast(&case.numbers("x", channels), channels, 0, &mut out);
                channels_first(&out, channels)
            }
            Kind::Head { voxels, channels, classes } => self.head(voxels, channels, classes),
        }
    }

    fn depthwise(&self, [height, width]: [usize; 2], channels: usize, side: usize) -> Vec<f32> {
        let case = self.case;
        let weight = case.weights("weight", channels * side * side);
        let args = Depthwise {
            input: &self.rows("x", height * width, channels),
            height,
            width,
            channels,
            kernel: side,
            weights: &taps(&weight, channels),
            bias: &padded(&vec![0.0; channels]),
            residual: true,
        };
        let mut out = vec![f32::NAN; height * width * channels];
        depthwise(self.isa, &args, 0..height, &mut out);
        channels_first(&out, channels)
    }

    fn batch_norm(&self, positions: usize, channels: usize, after: After) -> Vec<f32> {
        let case = self.case;
        let (scale, shift) = norm(case, "", channels);
        let residual = self.rows("residual", positions, channels);
        let args = ScaleShift {
            scale: &padded(&scale),
            shift: &padded(&shift),
            channels,
            first_channel: 0,
            stride: channels,
            residual: adds(after).then_some(&residual),
            residual_after: after == After::ReluAdd,
            relu: after != After::Nothing,
        };
        let mut out = self.rows("x", positions, channels);
        scale_shift(self.isa, &args, &mut out);
        channels_first(&out, channels)
    }

    fn gather(&self, rows: &[usize], cameras: usize, pixels: usize, channels: usize) -> Vec<f32> {
        let case = self.case;
        let (ptr, col) = case.matrix(rows, cameras * pixels);
        let features: Vec<f32> =
            (0..cameras).flat_map(|i| self.rows(&format!("camera {i}"), pixels, channels)).collect();
        let args = Gather {
            ptr: &ptr,
            col: &col,
            mask: None,
            features: &features,
            stride: channels,
            first_channel: 0,
            channels,
            bias: None,
            relu: false,
        };
        let mut out = vec![f32::NAN; rows.len() * channels];
        gather(self.isa, &args, 0..rows.len(), &mut out);
        channels_first(&out, channels)
    }

    fn conv(&self) -> Vec<f32> {
        let Kind::Conv(shape) = self.case.kind else { unreachable!() };
        let table::Conv { extent, inputs, outputs, kernel, after, .. } = shape;
        let (stride, dilation, padding) = shape.axes();
        let output =
            std::array::from_fn(|a| (extent[a] + 2 * padding[a] - dilation[a] * (kernel[a] - 1) - 1) / stride[a] + 1);
        let geometry = Geometry { input: extent, channels: inputs, kernel, stride, dilation, padding, output };
        let positions = geometry.rows();
        let weight = self.case.weights("weight", outputs * geometry.depth());
        let residual = self.rows("residual", positions, outputs);
        let weights = self.packed(&weight, inputs, outputs);
        let args = Conv {
            geometry,
            input: &self.rows("x", extent.iter().product(), inputs),
            product: Product {
                weights: weights.panels(),
                bias: &padded(&self.case.weights("bias", outputs)),
                depth: geometry.depth(),
                columns: outputs,
                relu: after != After::Nothing,
                residual: match after {
                    After::AddRelu => Residual::Before { rows: &residual, stride: outputs },
                    After::ReluAdd => Residual::After { rows: &residual, stride: outputs },
                    After::Nothing | After::Relu => Residual::None,
                },
            },
        };
        let mut out = vec![f32::NAN; positions * outputs];
        conv(self.isa, &args, 0..positions, outputs, &mut out, &mut scratch());
        channels_first(&out, outputs)
    }

    fn deform_conv(&self) -> Vec<f32> {
        let Kind::DeformConv { height, width, inputs, outputs, reach } = self.case.kind else { unreachable!() };
        let extent = [1, height, width];
        let geometry = Geometry {
            input: extent,
            channels: inputs,
            kernel: [1, 3, 3],
            stride: [1; 3],
            dilation: [1; 3],
            padding: [0, 1, 1],
            output: extent,
        };
        let positions = height * width;
        let weights = self.packed(&self.case.weights("weight", outputs * inputs * 9), inputs, outputs);
        let args = DeformConv2d {
            geometry,
            input: &self.rows("x", positions, inputs),
            offsets: &channels_last(&self.case.offsets(positions, reach), OFFSETS),
            product: Product {
                weights: weights.panels(),
                bias: &padded(&vec![0.0; outputs]),
                depth: geometry.depth(),
                columns: outputs,
                relu: false,
                residual: Residual::None,
            },
        };
        let mut out = vec![f32::NAN; positions * outputs];
        deform_conv2d(self.isa, &args, 0..positions, outputs, &mut out, &mut scratch());
        channels_first(&out, outputs)
    }

    fn deconv(&self) -> Vec<f32> {
        let Kind::Deconv { extent, inputs, outputs, after } = self.case.kind else { unreachable!() };
        let raw = self.case.weights("weight", inputs * outputs * 64);
        let mut weights = vec![];
        for parity in 0..8 {
            weights.extend(packed(8 * inputs, outputs, |k, n| {
                let (tap, c) = (k / inputs, k % inputs);
                let bits = |v: usize| [v >> 2 & 1, v >> 1 & 1, v & 1];
                let axes = bits(parity).into_iter().zip(bits(tap));
                raw[axes.fold(c * outputs + n, |at, (parity, tap)| at * 4 + kernel_tap(parity, tap))]
            }));
        }
        let weights = self.store(weights);
        let positions = 8 * extent.iter().product::<usize>();
        let residual = self.rows("residual", positions, outputs);
        let args = Deconv3d {
            extent,
            channels: inputs,
            columns: outputs,
            input: &self.rows("x", positions / 8, inputs),
            weights: weights.panels(),
            bias: &padded(&self.case.weights("bias", outputs)),
            relu: after != After::Nothing,
            add: adds(after).then_some(&residual),
        };
        let mut out = vec![f32::NAN; positions * outputs];
        deconv3d(self.isa, &args, 0..2 * extent[0], &mut out, &mut scratch());
        channels_first(&out, outputs)
    }

    fn attention(&self, extent: [usize; 2], heads: usize, part: usize) -> Vec<f32> {
        let channels = heads * part;
        let shape = Shape { extent, channels, heads, key_dim: part };
        let folded = |name: String, len: usize, outputs: usize| {
            let mut weight = self.case.scaled(&name, len, len / outputs);
            let (scale, shift) = norm(self.case, &format!("{name}."), outputs);
            for (row, scale) in weight.chunks_exact_mut(len / outputs).zip(scale) {
                row.iter_mut().for_each(|w| *w *= scale);
            }
            (weight, padded(&shift))
        };
        let dense =
            |weight: &[f32], inputs: usize, outputs: usize| packed(inputs, outputs, |k, n| weight[n * inputs + k]);
        let [mut qkv, mut qkv_bias, mut query, mut query_bias, mut offsets] = [const { Vec::<f32>::new() }; 5];
        for i in 0..heads {
            let (weight, bias) = folded(format!("qkv.{i}"), 3 * part * part, 3 * part);
            qkv.extend(dense(&weight, part, 3 * part));
            qkv_bias.extend(bias);
            let (weight, bias) = folded(format!("query.{i}"), part * QUERY_TAPS, part);
            query.extend(taps(&weight, part));
            query_bias.extend(bias);
            offsets.extend(self.case.numbers(&format!("offsets.{i}"), shape.side() * shape.side()));
        }
        let (proj, proj_bias) = folded("proj".to_owned(), channels * channels, channels);
        let args = WindowAttention {
            shape,
            input: &self.rows("x", extent[0] * extent[1], channels),
            qkv: &qkv,
            qkv_bias: &qkv_bias,
            query: &query,
            query_bias: &query_bias,
            offsets: &offsets,
            proj: &dense(&proj, channels, channels),
            proj_bias: &proj_bias,
        };
        let mut out = vec![];
        for row in 0..shape.window_rows() {
            let mut part = vec![f32::NAN; shape.rows(row).len() * extent[1] * channels];
            window_attention(self.isa, &args, row, &mut part, &mut vec![f32::NAN; shape.scratch_len()]);
            out.extend(part);
        }
        channels_first(&out, channels)
    }

    fn head(&self, voxels: usize, channels: usize, classes: usize) -> Vec<f32> {
        let layer = |i: usize, outputs: usize| {
            let weight = self.case.weights(&format!("{i}.weight"), outputs * channels);
            let bias = self.case.weights(&format!("{i}.bias"), outputs);
            (self.packed(&weight, channels, outputs), padded(&bias))
        };
        let layers = [layer(0, channels), layer(1, channels), layer(2, classes)];
        let args = Head {
            input: &self.rows("x", voxels, channels),
            channels,
            classes,
            weights: [0, 1, 2].map(|i| layers[i].0.panels()),
            biases: [0, 1, 2].map(|i| layers[i].1.as_slice()),
        };
        let (mut found, mut logits) = (vec![0; voxels], vec![f32::NAN; voxels * classes]);
        let mut scratch = vec![f32::NAN; voxcast_kernels::head::scratch_len(channels, classes)];
        let results = Results { classes: &mut found, logits: Some(&mut logits), confidence: None };
        head(self.isa, &args, 0..voxels, results, &mut scratch);
        logits
    }
}

fn scratch() -> Vec<f32> {
    vec![f32::NAN; SCRATCH]
}

fn adds(after: After) -> bool {
    matches!(after, After::AddRelu | After::ReluAdd)
}

/// A batch norm as factor and addend.
fn norm(case: &Case, prefix: &str, channels: usize) -> (Vec<f32>, Vec<f32>) {
    let [gamma, variance] = ["gamma", "variance"].map(|part| case.positive(&format!("{prefix}{part}"), channels));
    let [beta, mean] = ["beta", "mean"].map(|part| case.weights(&format!("{prefix}{part}"), channels));
    let wide = |v: &[f32]| v.iter().map(|&v| f64::from(v)).collect::<Vec<_>>();
    let scale: Vec<f64> = wide(&gamma).iter().zip(wide(&variance)).map(|(g, v)| g / (v + 1e-5).sqrt()).collect();
    let shift = wide(&beta).into_iter().zip(wide(&mean)).zip(&scale).map(|((b, m), s)| (b - m * s) as f32).collect();
    (scale.iter().map(|&s| s as f32).collect(), shift)
}

fn packed(depth: usize, columns: usize, element: impl Fn(usize, usize) -> f32) -> Vec<f32> {
    let mut out = vec![0.0; packed_len(depth, columns)];
    pack(depth, columns, element, &mut out);
    out
}

/// `[channels, taps]` to `[taps, padded channels]`.
fn taps(weight: &[f32], channels: usize) -> Vec<f32> {
    channels_last(weight, channels).chunks_exact(channels).flat_map(padded).collect()
}

fn padded(values: &[f32]) -> Vec<f32> {
    let mut out = values.to_vec();
    out.resize(values.len().next_multiple_of(LANES), 0.0);
    out
}

/// `[channels, positions]` to `[positions, channels]`.
fn channels_last(values: &[f32], channels: usize) -> Vec<f32> {
    let positions = values.len() / channels;
    (0..values.len()).map(|i| values[i % channels * positions + i / channels]).collect()
}

/// `[positions, channels]` to `[channels, positions]`.
fn channels_first(values: &[f32], channels: usize) -> Vec<f32> {
    channels_last(values, values.len() / channels)
}

/// The largest difference over the root mean square of what is expected.
fn apart(found: &[f32], expected: &[f32]) -> f64 {
    let square: f64 = expected.iter().map(|&v| f64::from(v) * f64::from(v)).sum();
    let off = found.iter().zip(expected).map(|(&a, &b)| (f64::from(a) - f64::from(b)).abs());
    // `max` would drop a NaN.
    let largest = off.fold(0.0, |most: f64, off| if off > most || off.is_nan() { off } else { most });
    largest / (square / expected.len() as f64).sqrt().max(f64::MIN_POSITIVE)
}

#[test]
fn kernels_agree_with_the_reference() {
    let directory = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/golden/reference");
    let manifest = std::fs::read_to_string(directory.join("manifest.json")).unwrap();
    let manifest: serde_json::Value = serde_json::from_str(&manifest).unwrap();
    let tolerance = |kind: &str| manifest["tolerance"][kind]["max"].as_f64().unwrap();
    let bytes = std::fs::read(directory.join("operations.safetensors")).unwrap();
    let file = SafeTensors::deserialize(&bytes).unwrap();
    let mut report = "largest difference over the rms, and at most\n".to_owned();
    let mut good = true;
    for case in &table() {
        let tensor = file.tensor(case.name).unwrap();
        let expected: Vec<f32> = tensor.data().as_chunks().0.iter().map(|&b| f32::from_le_bytes(b)).collect();
        let most = tolerance(if matches!(case.kind, Kind::WindowAttention { .. }) { "attention" } else { "operation" });
        for isa in Isa::available() {
            for half in [false, true] {
                let found = Run { case, isa, half }.result();
                assert_eq!(found.len(), expected.len(), "{}", case.name);
                let off = apart(&found, &expected);
                let mark = if off <= most { "" } else { "  <- too far" };
                good &= off <= most;
                let precision = if half { "f16" } else { "f32" };
                writeln!(report, "{:24} {:8} {precision} {off:9.2e} {most:7.0e}{mark}", case.name, isa.name()).unwrap();
            }
        }
    }
    assert!(good, "{report}");
    let names: BTreeSet<String> = table().iter().map(|c| c.name.to_owned()).collect();
    assert_eq!(names.len(), table().len(), "names are unique");
    assert_eq!(names, file.names().into_iter().map(str::to_owned).collect(), "every expected result is compared");
}

#[test]
fn the_comparison_sees_a_single_wrong_number() {
    assert_eq!(apart(&[1.0, 2.0], &[1.0, 2.0]), 0.0);
    assert!((apart(&[1.0, 2.5], &[1.0, 2.0]) - 0.5 / 2.5f64.sqrt()).abs() < 1e-12);
    assert!(apart(&[1.0, f32::NAN], &[1.0, 2.0]).is_nan());
}
