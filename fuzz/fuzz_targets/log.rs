//! Any bytes as a robot log: an error, or frames that can be read, or fail cleanly.
//!
//! The input is tried as a whole file, and as the contents of one chunk that is not packed: its checksum may be left out, so that
//! mutation reaches the messages.

#![no_main]

use libfuzzer_sys::fuzz_target;
use std::sync::OnceLock;
use voxcast::Network;
use voxcast::log::{Replay, ReplayOptions};

/// One small camera.
fn network() -> &'static Network {
    static NETWORK: OnceLock<Network> = OnceLock::new();
    NETWORK.get_or_init(|| Network { image: [32, 64], cameras: 1, ..Network::built_in("edge").expect("built in") })
}

fn replay(bytes: Vec<u8>) {
    let Ok(mut replay) = Replay::from_bytes(bytes, network(), &ReplayOptions::default()) else { return };
    let summary = replay.summary();
    assert_eq!((summary.frames, summary.cameras.len()), (replay.len(), 1));
    for index in 0..replay.len().min(4) {
        if let Ok(frame) = replay.frame(index) {
            let image = &frame.scene.images[0];
            assert_eq!(image.bgr.len(), 3 * image.height * image.width);
            assert!(frame.scene.lidar2img[0].iter().all(|v| v.is_finite()));
        }
    }
}

fuzz_target!(|bytes: &[u8]| {
    replay(bytes.to_vec());
    let mut log = b"\x89MCAP0\r\n".to_vec();
    let record = |log: &mut Vec<u8>, op: u8, body: &[u8]| {
        log.push(op);
        log.extend((body.len() as u64).to_le_bytes());
        log.extend(body);
    };
    // Times, size, no checksum, no compression, size.
    let size = (bytes.len() as u64).to_le_bytes();
    let header = [&[0; 16][..], &size, &[0; 8], &size].concat();
    record(&mut log, 6, &[&header, bytes].concat());
    replay(log);
});
