//! What a camera's matrices must be, as far as it can be told from the numbers alone.

/// How far the product of a rotation and its transpose may be from the unit matrix, in every element. Rotations that were
/// written with three decimals pass; a scale of 1.003 or a transposed frame does not.
const RIGID_TOLERANCE: f64 = 5e-3;

/// How far elements that must be 0 or 1 may be from it.
const EXACT: f64 = 1e-6;

/// What is wrong with a matrix: `found` and `expected`, for a message.
pub(crate) type Wrong = (String, &'static str);

/// Checks a row-major 4x4 that takes metres of one frame of reference to metres of another: a rotation and a translation.
pub(crate) fn check_rigid(m: &[[f64; 4]; 4]) -> Result<(), Wrong> {
    check_last_row(m)?;
    let rotation = [m[0], m[1], m[2]].map(|[x, y, z, _]| [x, y, z]);
    for (i, a) in rotation.iter().enumerate() {
        for (j, b) in rotation.iter().enumerate() {
            let dot: f64 = a.iter().zip(b).map(|(a, b)| a * b).sum();
            let unit = f64::from(u8::from(i == j));
            if !is_near(dot, unit, RIGID_TOLERANCE) {
                let found = if i == j {
                    format!("scaled: row {i} of its rotation has length {:.6}", dot.sqrt())
                } else {
                    format!("skewed: rows {i} and {j} of its rotation have the product {dot:.6}")
                };
                return Err((found, "a rotation and a translation, within 0.005"));
            }
        }
    }
    if determinant(&rotation) < 0.0 {
        return Err(("mirrored: its determinant is -1".into(), "a rotation, whose determinant is 1"));
    }
    Ok(())
}

/// Checks a row-major intrinsic: upper triangular, with positive focal lengths and a last row of (0, 0, 1).
pub(crate) fn check_intrinsic(k: &[[f64; 3]; 3]) -> Result<(), Wrong> {
    const EXPECTED: &str = "[f, s, cu], [0, f, cv], [0, 0, 1]";
    for (row, column, value) in [(1, 0, 0.0), (2, 0, 0.0), (2, 1, 0.0), (2, 2, 1.0)] {
        if !is_near(k[row][column], value, EXACT) {
            let transposed = if k[0][2] == 0.0 && k[2][0] != 0.0 { ", as if transposed" } else { "" };
            return Err((format!("{} in row {row}, column {column}{transposed}", k[row][column]), EXPECTED));
        }
    }
    match (0..2).find(|&i| !(k[i][i] > 0.0 && k[i][i].is_finite())) {
        Some(i) => Err((format!("{} in row {i}, column {i}", k[i][i]), "focal lengths greater than 0")),
        None => Ok(()),
    }
}

/// Checks a row-major 4x4 from lidar-frame metres to (u * d, v * d, d, 1): a last row of (0, 0, 0, 1), and three rows that
/// span the space. Its camera and its pose cannot be told apart for certain, so that a scale of all is not seen.
pub(crate) fn check_projection(m: &[[f64; 4]; 4]) -> Result<(), Wrong> {
    check_last_row(m)?;
    if handedness(m) == 0.0 {
        return Err(("singular: its rows do not span the space".into(), "a camera's projection"));
    }
    Ok(())
}

/// The determinant of the first three rows and columns with rows of length 1; 0 where they do not span the space. A camera
/// that is mirrored has one below 0.
pub(crate) fn handedness(m: &[[f64; 4]; 4]) -> f64 {
    let unit = [m[0], m[1], m[2]].map(|[x, y, z, _]| {
        let length = (x * x + y * y + z * z).sqrt();
        [x, y, z].map(|v| v / length)
    });
    let determinant = determinant(&unit);
    // Rows that are 0 give NaN.
    if determinant.abs() > 1e-9 { determinant } else { 0.0 }
}

/// Whether two projections take points to the same pixels, within a thousandth of what their rows hold. The scale of the
/// three rows does not matter.
pub(crate) fn alike(a: &[[f64; 4]; 4], b: &[[f64; 4]; 4]) -> bool {
    let scale = |m: &[[f64; 4]; 4]| (m[2][0] * m[2][0] + m[2][1] * m[2][1] + m[2][2] * m[2][2]).sqrt();
    let (sa, sb) = (scale(a), scale(b));
    a[..3].iter().zip(&b[..3]).all(|(a, b)| {
        let most = a.iter().fold(0.0f64, |most, v| most.max((v / sa).abs()));
        a.iter().zip(b).all(|(a, b)| (a / sa - b / sb).abs() <= 1e-3 * most)
    })
}

/// Whether two numbers are within a tolerance. One that is not finite never is.
fn is_near(found: f64, expected: f64, tolerance: f64) -> bool {
    (found - expected).abs() <= tolerance
}

fn check_last_row(m: &[[f64; 4]; 4]) -> Result<(), Wrong> {
    let last = m[3];
    if last.iter().zip([0.0, 0.0, 0.0, 1.0]).all(|(&v, expected)| is_near(v, expected, EXACT)) {
        return Ok(());
    }
    let transposed = (0..3).all(|row| m[row][3] == 0.0) && last[3] == 1.0;
    let hint = if transposed { ", as if transposed" } else { "" };
    Err((format!("{last:?} in row 3{hint}"), "[0, 0, 0, 1]: points are columns"))
}

fn determinant([a, b, c]: &[[f64; 3]; 3]) -> f64 {
    a[0] * (b[1] * c[2] - b[2] * c[1]) - a[1] * (b[0] * c[2] - b[2] * c[0]) + a[2] * (b[0] * c[1] - b[1] * c[0])
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A turn by `a` about an axis that is none of the frame's, and a translation.
    fn pose(a: f64) -> [[f64; 4]; 4] {
        let (s, c) = a.sin_cos();
        let (t, u) = 0.4f64.sin_cos();
        [[c, -s, 0.0, 1.5], [s * u, c * u, -t, -0.25], [s * t, c * t, u, 3.0], [0.0, 0.0, 0.0, 1.0]]
    }

    fn transposed<const N: usize>(m: [[f64; N]; N]) -> [[f64; N]; N] {
        std::array::from_fn(|r| std::array::from_fn(|c| m[c][r]))
    }

    const K: [[f64; 3]; 3] = [[500.0, 0.5, 320.0], [0.0, 510.0, 240.0], [0.0, 0.0, 1.0]];

    #[test]
    fn rotations_pass_and_everything_else_is_named() {
        for i in 0..40 {
            check_rigid(&pose(f64::from(i) * 0.7)).unwrap();
            let three_decimals = pose(f64::from(i) * 0.7).map(|row| row.map(|v| (v * 1e3).round() / 1e3));
            check_rigid(&three_decimals).unwrap();
        }
        let edit = |change: fn(&mut [[f64; 4]; 4])| {
            let mut m = pose(0.9);
            change(&mut m);
            m
        };
        for (m, expected) in [
            (transposed(pose(0.9)), "as if transposed"),
            (edit(|m| m[3] = [0.0, 0.0, 0.0, 2.0]), "[0.0, 0.0, 0.0, 2.0] in row 3"),
            (edit(|m| m[3] = [0.0; 4]), "in row 3"),
            (edit(|m| m[3][0] = f64::NAN), "in row 3"),
            (edit(|m| m[0] = m[0].map(|v| v * 1.01)), "scaled: row 0 of its rotation has length 1.01"),
            (edit(|m| m.iter_mut().take(3).for_each(|r| *r = r.map(|v| v * 1e3))), "scaled: row 0"),
            (edit(|m| m[2] = [0.0; 4]), "rows 2 and 2"),
            (edit(|m| m[1] = m[0]), "skewed: rows 0 and 1 of its rotation have the product 1"),
            (edit(|m| m[1] = m[1].map(|v| -v)), "mirrored"),
            (edit(|m| m.swap(0, 1)), "mirrored"),
            (edit(|m| m[1][1] = f64::NAN), "of its rotation"),
            (edit(|m| m[1][1] = f64::INFINITY), "of its rotation"),
        ] {
            let (found, _) = check_rigid(&m).expect_err(expected);
            let row_of_zeros =
                expected == "rows 2 and 2" && found == "scaled: row 2 of its rotation has length 0.000000";
            assert!(found.contains(expected) || row_of_zeros, "{found} (expected {expected})");
        }
        // A translation may be anything: nothing in the numbers tells metres from millimetres.
        check_rigid(&edit(|m| m[0][3] = 1e6)).unwrap();
    }

    #[test]
    fn intrinsics_are_upper_triangular() {
        check_intrinsic(&K).unwrap();
        let edit = |row: usize, column: usize, value: f64| {
            let mut k = K;
            k[row][column] = value;
            k
        };
        let mut skewless = K;
        skewless[0][1] = 0.0;
        for (k, expected) in [
            (transposed(skewless), "320 in row 2, column 0, as if transposed"),
            (K.map(|row| row.map(|v| 2.0 * v)), "2 in row 2, column 2"),
            (edit(0, 0, 0.0), "0 in row 0, column 0"),
            (edit(1, 1, -510.0), "-510 in row 1, column 1"),
            (edit(1, 0, 0.5), "0.5 in row 1, column 0"),
            (edit(2, 1, 1e-3), "0.001 in row 2, column 1"),
            (edit(2, 2, f64::NAN), "NaN in row 2"),
            (edit(0, 0, f64::INFINITY), "inf in row 0"),
        ] {
            let (found, _) = check_intrinsic(&k).expect_err(expected);
            assert!(found.contains(expected), "{found} (expected {expected})");
        }
    }

    #[test]
    fn projections_span_the_space() {
        let rows = |m: [[f64; 4]; 4], k: [[f64; 3]; 3]| -> [[f64; 4]; 4] {
            std::array::from_fn(|r| match r {
                3 => m[3],
                _ => std::array::from_fn(|c| (0..3).map(|i| k[r][i] * m[i][c]).sum()),
            })
        };
        let sound = rows(pose(0.9), K);
        check_projection(&sound).unwrap();
        assert!(handedness(&sound) > 0.0);
        let mirrored = rows(pose(0.9), [[-500.0, 0.0, 320.0], K[1], K[2]]);
        check_projection(&mirrored).unwrap();
        assert!(handedness(&mirrored) < 0.0);
        check_projection(&transposed(sound)).expect_err("transposed");
        for row in 0..3 {
            let mut flat = sound;
            flat[row] = [0.0, 0.0, 0.0, 1.0];
            check_projection(&flat).expect_err("a row of zeros");
            flat[row] = sound[(row + 1) % 3];
            check_projection(&flat).expect_err("a row twice");
        }
        check_projection(&[[0.0; 4]; 4]).expect_err("zeros");
    }
}
