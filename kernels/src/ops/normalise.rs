//! Camera bytes to network input: minus the mean, then zeros below and to the right.
//!
//! Each output is one exactly rounded subtraction, so there is nothing that an instruction set could change.

/// Mean of blue, green and red over the data that the backbones were trained on, in units of a byte. (Caffe's ImageNet
/// statistics; the published networks divide by nothing.)
pub const BGR_MEAN: [f32; 3] = [103.530, 116.280, 123.675];

/// Rows `first_row..` of the padded image into `out`, which holds whole rows of `padded_width` pixels.
///
/// `image` is `[height, width, 3]` blue first. Rows from `height` on, and pixels from `width` on, are zero.
///
/// # Panics
/// If `image` is not `height * width * 3` bytes, or `out` is not whole rows.
pub fn normalise(image: &[u8], height: usize, width: usize, padded_width: usize, first_row: usize, out: &mut [f32]) {
    fill(image, [height, width], padded_width, first_row, out, |pixel| {
        core::array::from_fn::<_, 3, _>(|c| f32::from(pixel[c]) - BGR_MEAN[c])
    });
}

/// Rows `first_row..` of the padded image into `out`: what `value` makes of a pixel, and zero where there is none.
///
/// # Panics
/// As [`normalise`].
pub(super) fn fill<T: Copy + Default, const N: usize>(
    image: &[u8],
    [height, width]: [usize; 2],
    padded_width: usize,
    first_row: usize,
    out: &mut [T],
    value: impl Fn([u8; 3]) -> [T; N],
) {
    assert_eq!(image.len(), height * width * 3, "the image has another size");
    assert!(padded_width >= width && out.len().is_multiple_of(padded_width * N), "the output is not whole rows");
    for (i, row) in out.chunks_exact_mut(padded_width * N).enumerate() {
        let (pixels, padding) = row.split_at_mut(if first_row + i < height { width * N } else { 0 });
        padding.fill(T::default());
        if !pixels.is_empty() {
            let from = &image[(first_row + i) * width * 3..][..width * 3];
            for (to, from) in pixels.as_chunks_mut::<N>().0.iter_mut().zip(from.as_chunks::<3>().0) {
                *to = value(*from);
            }
        }
    }
}

#[cfg(feature = "cases")]
pub(crate) mod cases;
#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn subtracts_and_pads_by_zero() {
        let image: Vec<u8> = (0..12).collect();
        let mut out = vec![9.0; 3 * 3 * 3];
        normalise(&image, 2, 2, 3, 0, &mut out);
        assert_eq!(out[..3], [0.0 - 103.53, 1.0 - 116.28, 2.0 - 123.675]);
        assert_eq!(out[6..9], [0.0; 3]);
        assert_eq!(out[9..12], [6.0 - 103.53, 7.0 - 116.28, 8.0 - 123.675]);
        assert_eq!(out[18..], [0.0; 9]);
        let mut last = vec![9.0; 9];
        normalise(&image, 2, 2, 3, 1, &mut last);
        assert_eq!(last, out[9..18]);
    }
}
