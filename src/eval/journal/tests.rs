use super::*;
use std::fs;

const KIND: Kind = Kind { classes: 3, regions: 2, rings: 2 };

fn subject(data: &str, predictors: usize) -> Subject {
    Subject {
        data: data.to_owned(),
        frames: 9,
        ids: "0123456789abcdef".to_owned(),
        predictors: vec!["model 0".to_owned(); predictors],
        published: vec![None; predictors],
        size: [4, 4, 2],
        bounds: [[-0.1, 0.3]; 3],
        classes: ["empty", "a", "b"].map(str::to_owned).to_vec(),
        masks: vec![],
        losses: true,
        calibration: true,
        rings: vec![20.0],
        version: "1".to_owned(),
    }
}

fn entry(seed: u8, predictors: usize) -> Entry {
    Entry {
        frame: format!("frame \"{seed}\""),
        index: usize::from(seed),
        truth: u64::MAX / 3 - u64::from(seed),
        score: frame(seed, predictors),
    }
}

fn frame(seed: u8, predictors: usize) -> FrameScore {
    let mut scores = vec![Score::new(KIND); predictors];
    for score in &mut scores {
        score.regions[1][0].add(seed % 3, 2);
        (score.rays.labelled[1], score.rays.predicted[1]) = (9, 12);
        score.published.add(3, seed % 3);
        score.rays.hits[2][1] = u64::from(seed);
        score.calibration[1].add([seed, 255], seed % 3, 1);
        let value = f64::from(seed) / 3.0;
        score.losses.add(&Losses { focal: value, lovasz: value.exp(), geometric: 1e-300, semantic: -0.0 });
    }
    let agreement = (predictors == 2).then(|| Confusion::new(3));
    FrameScore { digests: vec![u64::MAX - u64::from(seed); predictors], scores, agreement }
}

fn open(path: &Path, what: &str, predictors: usize, shard: Shard) -> Result<(Journal, Vec<Entry>)> {
    let mut found = Vec::new();
    let header = Header::new(subject(what, predictors), shard, vec!["a name".to_owned(); predictors]);
    let journal = Journal::open(path, &header, &mut |entry| {
        found.push(entry);
        Ok(())
    })?;
    Ok((journal, found))
}

#[test]
fn frames_come_back_in_bits_and_a_cut_line_is_dropped() {
    for predictors in [1, 2] {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("journal");
        let (mut journal, found) = open(&path, "x", predictors, Shard::WHOLE).unwrap();
        assert_eq!(subject("x", predictors).kind(), KIND);
        assert!(found.is_empty());
        let frames: Vec<Entry> = (1..4).map(|seed| entry(seed, predictors)).collect();
        frames.iter().for_each(|entry| journal.append(entry).unwrap());
        drop(journal);
        let whole = fs::read(&path).unwrap();
        let header = whole.iter().position(|&b| b == b'\n').unwrap() + 1;
        // Cut anywhere, it opens with the frames whose lines are whole, and goes on from there.
        for length in 0..=whole.len() {
            fs::write(&path, &whole[..length]).unwrap();
            let lines = whole[..length].iter().filter(|&&b| b == b'\n').count();
            let (mut journal, found) = open(&path, "x", predictors, Shard::WHOLE).unwrap();
            assert_eq!(found, frames[..lines.saturating_sub(1)], "{length} bytes");
            journal.append(&frames[0]).unwrap();
            drop(journal);
            let kept = whole[..length].iter().rposition(|&b| b == b'\n').map_or(header, |last| last + 1);
            assert_eq!(fs::read(&path).unwrap()[..kept], whole[..kept]);
            assert_eq!(open(&path, "x", predictors, Shard::WHOLE).unwrap().1.len(), lines.max(1));
        }
    }
}

#[test]
fn what_does_not_belong_is_refused_and_left_alone() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("journal");
    let shard = |text: &str| text.parse::<Shard>().unwrap();
    let refused = |bytes: &[u8], what: &str, predictors: usize, part: &str, expected: &str| {
        fs::write(&path, bytes).unwrap();
        let error = open(&path, what, predictors, shard(part)).unwrap_err();
        assert!(error.message().contains(expected), "{error} does not say {expected:?}");
        assert_eq!(error.path(), Some(path.as_path()));
        assert_eq!(fs::read(&path).unwrap(), bytes);
    };
    let (mut journal, _) = open(&path, "x", 1, shard("1/2")).unwrap();
    journal.append(&entry(1, 1)).unwrap();
    let error = open(&path, "x", 1, shard("1/2")).unwrap_err();
    assert!(error.message().contains("another evaluation has it open"), "{error}");
    drop(journal);
    let good = fs::read(&path).unwrap();
    refused(&good, "y", 1, "1/2", "another evaluation: \"data\": found \"x\", expected \"y\"");
    refused(&good, "x", 2, "1/2", "another evaluation: \"predictors\"");
    refused(&good, "x", 1, "1/3", "of shard 1/2, expected 1/3");
    refused(b"my notes", "x", 1, "1/2", "not a journal");
    refused(b"my notes\n", "x", 1, "1/2", "line 1");
    let text = String::from_utf8(good).unwrap();
    for (from, to, expected) in [
        ("\"regions\":[", "\"regions\":[[],", "line 2: counts that no frame"),
        ("[5,1]", "[9,1]", "line 2: counts"),
        ("[5,1]", "[5]", "line 2: counts"),
        ("[5,1]", "[5,1099511627777]", "line 2: counts"),
        ("[0,9,0]", "[0,0,0]", "line 2: counts"),
        ("fffffffe\"]", "fffffffe\",\"0\"]", "line 2: counts"),
        ("[511,1]", "[512,1]", "line 2: counts"),
        ("\"calibration\":[[", "\"calibration\":[[[],[]],[", "line 2: counts"),
        ("\"truth\":\"", "\"truth\":\"0", "line 2: counts"),
        ("\"losses\":[", "\"loses\":[", "line 2: "),
        ("\"index\":1", "\"index\":2", "line 2: frame 2 is not of shard 1/2"),
        ("\"index\":1", "\"index\":9", "line 2: frame 9, expected one of 9"),
        ("\"version\":4", "\"version\":1", "of version 1, expected"),
        ("[\"a name\"]", "[]", "line 1: 0 names"),
        ("\"shard\":[1,2]", "\"shard\":[2,2]", "line 1: shard 2/2"),
    ] {
        assert!(text.contains(from), "{from}");
        refused(text.replacen(from, to, 1).as_bytes(), "x", 1, "1/2", expected);
    }
}
