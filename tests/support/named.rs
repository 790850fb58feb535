//! Random numbers that a name determines.

use voxcast::random::Random;

/// Those of `what` of the case `name`.
pub(crate) fn random(name: &str, what: &str) -> Random {
    let seed = name.bytes().chain(*b":").chain(what.bytes());
    Random::new(seed.fold(0xcbf2_9ce4_8422_2325, |h, b| (h ^ u64::from(b)).wrapping_mul(0x0100_0000_01b3)))
}

/// Offsets of a matrix with rows of these lengths, then ascending columns below `columns` without duplicates.
pub(crate) fn matrix(mut random: Random, rows: &[usize], columns: usize) -> (Vec<u32>, Vec<u32>) {
    let (mut ptr, mut col) = (vec![0], vec![]);
    for &len in rows {
        let mut row = std::collections::BTreeSet::new();
        while row.len() < len {
            row.insert(random.below(columns) as u32);
        }
        col.extend(row);
        ptr.push(col.len() as u32);
    }
    (ptr, col)
}
