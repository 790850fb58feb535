//! [`super::project_points()`] with any arguments, and at the network's shapes.

use super::{Projection, Sum, project_points};
use crate::cases::{Bench, Case, Draw, Memory, Output, values};
use crate::isa::Isa;
use std::vec;
use std::vec::Vec;

struct Call {
    projection: Projection,
    axes: [Vec<f32>; 3],
}

pub(crate) fn draw(draw: &mut Draw) -> Option<impl Case + use<>> {
    let sum = if draw.flag() { Sum::Pairs } else { Sum::Chain };
    let stride_log2 = draw.extent(0, 7) as u32;
    let (width, height) = ((draw.extent(1, 40) as u32) << stride_log2, (draw.extent(1, 40) as u32) << stride_log2);
    let base = u32::from(draw.byte()) * if draw.flag() { 16_000_000 } else { 1 };
    if u64::from(base) + u64::from(width >> stride_log2) * u64::from(height >> stride_log2) > 1 << 32 {
        return None;
    }
    let lengths = [draw.extent(0, 5), draw.extent(0, 5), draw.extent(0, 40)];
    // Anything, or a camera that looks along z and sees about half of the points.
    let matrix = if draw.flag() {
        core::array::from_fn(|_| draw.value() * 64.0)
    } else {
        let [u, v] = [width, height].map(|size| size as f32 * 0.5);
        let mut scale = || 3.0 * draw.value();
        [u * scale(), 0.0, u, 2.0 * u, 0.0, v * scale(), v, 2.0 * v, 0.0, 0.0, 1.0, 2.0]
    };
    let projection = Projection { matrix, sum, width, height, stride_log2, base };
    Some(Call { projection, axes: lengths.map(|n| draw.values(n)) })
}

impl Case for Call {
    fn run(&self, isa: Isa, memory: Memory) -> Output {
        let [xs, ys, zs] = self.axes.each_ref().map(|axis| memory.hold(axis));
        let mut out = memory.filled(xs.len() * ys.len() * zs.len(), 7u32);
        let any = project_points(isa, &self.projection, &xs, &ys, &zs, &mut out);
        let codes = out.iter().copied().chain([u32::from(any)]).map(i64::from).collect();
        Output { values: Vec::new(), codes }
    }
}

/// The sample points of a column of each level of `nuscenes-200`, over and over. A pixel takes two divisions and nine
/// multiply-adds.
pub(crate) fn benches() -> Vec<Bench> {
    let levels = [("level1 columns", 4, 32), ("level2 columns", 5, 20), ("level3 columns", 6, 12)];
    levels.map(|(name, samples, depth)| bench(name, samples, depth)).into()
}

/// Columns of `samples` x and y, and `depth` z.
fn bench(name: &str, samples: usize, depth: usize) -> Bench {
    let columns = 1000;
    let projection = Projection {
        matrix: [160.0, 0.0, 160.0, 0.0, 0.0, 160.0, 80.0, 0.0, 0.0, 0.0, 1.0, 2.0],
        sum: Sum::Chain,
        width: 640,
        height: 320,
        stride_log2: 3,
        base: 1,
    };
    let (xs, zs) = (values(samples, 1.0), values(depth, 1.0));
    let each = samples * samples * depth;
    let mut found = vec![0; each];
    Bench::new(name, [columns, 1], 9 * each, columns * 4 * each, move |isa, columns, out| {
        for (_, out) in columns.zip(out) {
            project_points(isa, &projection, &xs, &xs, &zs, &mut found);
            *out = found.iter().fold(0, |sum: u32, pixel| sum.wrapping_add(*pixel)) as f32;
        }
    })
}
