//! Throughput by layer shape.
#![allow(missing_docs)]
fn cpu() -> f64 {
    std::fs::read_to_string("/proc/thread-self/schedstat").unwrap().split(" ").next().unwrap().parse::<f64>().unwrap()
        / 1e9
}
use voxcast_kernels::{conv::*, panels::*, product::*, *};
fn main() {
    let isa = Isa::best();
    for (name, dims, cin, cout, k, st) in [
        ("l1 1x1 64->256", [1usize, 232, 400], 64usize, 256usize, 1usize, 1usize),
        ("l1 1x1 256->64", [1, 232, 400], 256, 64, 1, 1),
        ("l1 3x3 64->64", [1, 232, 400], 64, 64, 3, 1),
        ("l2 3x3 128", [1, 116, 200], 128, 128, 3, 1),
        ("l3 1x1 1024->256", [1, 58, 100], 1024, 256, 1, 1),
        ("l3 1x1 256->1024", [1, 58, 100], 256, 1024, 1, 1),
        ("l4 1x1 2048->512", [1, 29, 50], 2048, 512, 1, 1),
        ("l4 1x1 512->2048", [1, 29, 50], 512, 2048, 1, 1),
        ("fpn 3x3 512->512", [1, 58, 100], 512, 512, 3, 1),
        ("fpn 3x3 512->128", [1, 116, 200], 512, 128, 3, 1),
        ("stem", [1, 928, 1600], 3, 64, 7, 2),
        ("off 3x3 256->27", [1, 58, 100], 256, 27, 3, 1),
        ("3d 32", [200, 200, 16], 32, 32, 3, 1),
        ("3d 64", [100, 100, 8], 64, 64, 3, 1),
        ("3d 256", [25, 25, 2], 256, 256, 3, 1),
    ] {
        let d3 = dims[0] > 1;
        let kernel = if d3 { [k; 3] } else { [1, k, k] };
        let stride = [1, st, st];
        let padding = if d3 { [k / 2; 3] } else { [0, k / 2, k / 2] };
        let output = [dims[0], dims[1] / st, dims[2] / st];
        let g = Geometry { input: dims, channels: cin, kernel, stride, dilation: [1; 3], padding, output };
        let x: Vec<f32> = (0..dims.iter().product::<usize>() * cin).map(|i| (i % 97) as f32 * 0.01).collect();
        let w = vec![0.01f32; packed_len(g.depth(), cout)];
        let bias = vec![0.0; cout.next_multiple_of(16)];
        let mut out = vec![0f32; g.rows() * cout];
        let mut scratch = vec![0f32; SCRATCH];
        let p = Product {
            weights: Panels::F32(&w),
            bias: &bias,
            depth: g.depth(),
            columns: cout,
            relu: true,
            residual: Residual::None,
        };
        let c = Conv { geometry: g, input: &x, product: p };
        let mut best = f64::MAX;
        for _ in 0..3 {
            let t = cpu();
            conv(isa, &c, 0..g.rows(), cout, &mut out, &mut scratch);
            best = best.min(cpu() - t);
        }
        let t = cpu();
        let (n, _) = voxcast_kernels::peak::multiply_adds(isa, 2_000_000);
        let peak = n as f64 / (cpu() - t);
        print!(
            "{:5.1} % of {:5.1} ",
            100.0 * g.rows() as f64 * g.depth() as f64 * cout as f64 / best / peak,
            peak / 1e9
        );
        println!(
            "{name:20} {:8.2} ms {:6.1} GMAC/s",
            best * 1e3,
            g.rows() as f64 * g.depth() as f64 * cout as f64 / best / 1e9
        );
    }
}
