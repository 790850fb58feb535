//! Logs that are cut off or damaged.

use super::written::written;
use super::*;

#[test]
fn a_log_that_is_cut_off_is_read_as_far_as_it_is_whole() {
    let scenes: Vec<_> = (0..3).map(|i| (i * SECOND, [i * SECOND; 2], scene(i))).collect();
    let bytes = written(&scenes);
    let (mut most, mut frames_before) = (0, 0);
    for length in (0..bytes.len()).step_by(997).chain([bytes.len() - 1, bytes.len() - 8]) {
        match replay(&bytes[..length]) {
            Ok(replay) => {
                let Extent { read, length: found, ending } = replay.summary().extent;
                assert!(ending != Ending::Whole && read <= found && found == length as u64, "{length}");
                let frames = replay.len();
                assert!(frames >= frames_before, "{length} bytes give {frames} frames, fewer than before");
                (most, frames_before) = (most.max(frames), frames);
            }
            Err(error) => {
                let expected = [
                    "begins with bytes",
                    "the log is cut off",
                    "the log is whole records",
                    "is not known at",
                    "no lidar among",
                ];
                assert!(expected.iter().any(|part| error.message().contains(part)), "{length}: {error}");
            }
        }
    }
    assert_eq!(most, 3);
    // Where a recorder's file is longer than what it has written.
    let mut padded = bytes[..bytes.len() - 5000].to_vec();
    padded.resize(bytes.len(), 0);
    assert_eq!(replay(&padded).expect("a log").summary().extent.ending, Ending::Cut);
}

#[test]
fn damage_is_named_and_never_a_panic() {
    let bytes = written(&[(0, [0; 2], scene(1))]);
    let mut random = crate::random::Random::new(3);
    for _ in 0..400 {
        let mut damaged = bytes.clone();
        for _ in 0..1 + random.below(3) {
            let at = random.below(damaged.len());
            damaged[at] = random.next_u64() as u8;
        }
        if let Ok(mut replay) = replay(&damaged) {
            for index in 0..replay.len() {
                let _ = replay.frame(index);
            }
        }
    }
    // A byte of a packed chunk.
    let chunk = bytes.windows(4).position(|w| w == [0x28, 0xb5, 0x2f, 0xfd]).expect("zstd");
    let mut damaged = bytes.clone();
    damaged[chunk + 40] ^= 0xff;
    assert_eq!(refused(&damaged, "chunk at byte"), ErrorKind::Format);
    // A chunk that claims more than it may, and one that claims other than it has.
    let size = chunk - 8 - 4 - 4 - 4 - 8;
    damaged = bytes.clone();
    damaged[size..size + 8].copy_from_slice(&u64::MAX.to_le_bytes());
    assert_eq!(refused(&damaged, "bytes unpacked, expected at most"), ErrorKind::TooLarge);
    damaged[size..size + 8].copy_from_slice(&1000u64.to_le_bytes());
    refused(&damaged, "other than 1000 bytes unpacked");
}
