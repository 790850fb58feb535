use super::*;
use crate::eval::dataset::{Axes, Pose};

const TRUTH: Grid = Grid { size: [4, 4, 2], bounds: [[-4.0, 4.0], [-4.0, 4.0], [-1.0, 1.0]], axes: Axes::Lidar };

fn truth(labels: Vec<u8>) -> Truth {
    let mask = (0..labels.len()).map(|i| u8::from(i % 3 == 0)).collect();
    Truth { labels, masks: vec![mask], origins: vec![[0.1, 0.2, 0.3]], grid_to_lidar: Pose::IDENTITY }
}

fn scorer(prediction: Grid) -> Scorer {
    Scorer::new(4, 1, TRUTH, prediction, &Options { rings: vec![2.0] }).expect("sound options")
}

fn blind(classes: &[u8]) -> Prediction<'_> {
    Prediction { classes, support: None, logits: None, confidence: None }
}

/// Classes 0 to 3 and ignored voxels, in no order.
fn labels() -> Vec<u8> {
    (0..32u8).map(|i| if i % 11 == 7 { IGNORED } else { (i * 7 + i / 5) % 4 }).collect()
}

#[test]
fn the_truth_scores_everything() {
    let truth = truth(labels());
    let prediction: Vec<u8> = truth.labels.iter().map(|&l| if l == IGNORED { 2 } else { l }).collect();
    let score = scorer(TRUTH).score(&truth, &blind(&prediction)).expect("a score");
    let all = score.region(0);
    assert_eq!((all.iou(), all.mean_iou(), all.accuracy()), (Some(1.0), Some(1.0), Some(1.0)));
    assert_eq!(all.voxels(), truth.labels.iter().filter(|&&l| l != IGNORED).count() as u64);
    assert_eq!(score.region(2).voxels(), 0, "without a rig, nothing is supported");
}

#[test]
fn regions_and_rings_by_hand() {
    let truth = truth(labels());
    let prediction: Vec<u8> = (0..32).map(|i| i % 4).collect();
    let support: Vec<u16> = (0..32).map(|i| u16::from(i >= 20)).collect();
    let found =
        scorer(TRUTH).score(&truth, &Prediction { support: Some(&support), ..blind(&prediction) }).expect("a score");
    let mut expected = Score::new(Kind { classes: 4, regions: 3, rings: 2 });
    for (i, &label) in truth.labels.iter().enumerate().filter(|&(_, &label)| label != IGNORED) {
        // Columns are 2 m wide: of 4 x 4, the inner four have their centres 1.41 m away, the others more than 3 m.
        let ring = usize::from(!((1..3).contains(&(i / 8)) && (1..3).contains(&(i / 2 % 4))));
        for (region, inside) in [true, i % 3 == 0, i >= 20].into_iter().enumerate() {
            if inside {
                expected.regions[region][ring].add(label, prediction[i]);
            }
        }
    }
    assert_eq!(found.regions, expected.regions);
}

#[test]
fn other_grids_are_asked_at_the_centres() {
    // Half as many voxels along x and y over a range that ends 2 m earlier; one layer, of the upper half.
    let coarse = Grid { size: [3, 3, 1], bounds: [[-4.0, 2.0], [-4.0, 2.0], [0.0, 1.0]], ..TRUTH };
    let prediction: Vec<u8> = (0..9).map(|i| 1 + i % 3).collect();
    let labels = vec![0; 32];
    let score = scorer(coarse).score(&truth(labels), &blind(&prediction)).expect("a score").region(0);
    // Nine of 32 voxels lie in it; each class is predicted three times, and empty elsewhere.
    assert_eq!([0, 1, 2, 3].map(|class| score.count(0, class)), [23, 3, 3, 3]);
    let fine = Grid { size: [8, 8, 4], ..TRUTH };
    let prediction: Vec<u8> = (0..256).map(|i| ((i / 4 % 8) / 4) as u8).collect();
    let score = scorer(fine).score(&truth(vec![0; 32]), &blind(&prediction)).expect("a score").region(0);
    assert_eq!([score.count(0, 0), score.count(0, 1)], [16, 16]);
}

#[test]
fn sums_do_not_depend_on_order() {
    let scorer = scorer(TRUTH);
    let score = |seed: u8| {
        let prediction: Vec<u8> = (0..32).map(|i| (i * seed) % 4).collect();
        scorer.score(&truth(labels()), &blind(&prediction)).expect("a score")
    };
    let sum = |seeds: [u8; 3]| {
        let mut sum = Score::new(Kind { classes: 4, regions: 3, rings: 2 });
        seeds.iter().for_each(|&seed| sum.merge(&score(seed)));
        sum
    };
    assert_eq!(sum([1, 2, 3]), sum([3, 1, 2]));
    assert_ne!(sum([1, 2, 3]), sum([1, 2, 2]));
}

#[test]
fn losses_need_the_same_grid() {
    let truth = truth(labels());
    let logits = vec![0.0; 128];
    let prediction = Prediction { logits: Some(&logits), ..blind(&[0; 32]) };
    let score = scorer(TRUTH).score(&truth, &prediction).expect("a score");
    // Four equal probabilities: -(3/4)^2 ln (1/4).
    let focal = score.losses.mean().expect("a frame").focal;
    assert!((focal - 0.5625 * 4f64.ln()).abs() < 1e-12, "{focal}");
    let shifted = Grid { bounds: [[-4.0, 4.0], [-4.0, 4.0], [-0.5, 1.5]], ..TRUTH };
    let error = scorer(shifted).score(&truth, &prediction).expect_err("other voxels");
    assert!(error.message().starts_with("losses need labels on the grid of the network"), "{error}");
}

#[test]
fn what_does_not_fit_is_refused() {
    let sound = || truth(labels());
    let scorer = scorer(TRUTH);
    let refused = |truth: &Truth, classes: &[u8], expected: &str| {
        let error = scorer.score(truth, &blind(classes)).expect_err(expected);
        assert!(error.message().contains(expected), "{error}");
    };
    refused(&sound(), &[0; 31], "predicted voxels: 31, expected 32");
    refused(&sound(), &[4; 32], "class 4, expected one of 4");
    refused(&truth(vec![9; 32]), &[0; 32], "class 9");
    refused(&truth(vec![0; 30]), &[0; 32], "labelled voxels: 30");
    refused(&Truth { masks: vec![], ..sound() }, &[0; 32], "masks: 0, expected 1");
    for rings in [vec![5.0, 2.0], vec![0.0], vec![f64::NAN]] {
        assert!(Scorer::new(4, 1, TRUTH, TRUTH, &Options { rings }).is_err());
    }
}

#[test]
fn labels_of_the_ego_frame_are_led_to_the_lidar() {
    // The lidar's y looks ahead; it sits 2 m ahead of the vehicle's origin and 1 m above: (x, y) is (-y, x - 2) of it.
    let ego = Grid { axes: Axes::Ego, ..TRUTH };
    let half = 0.5f64.sqrt();
    let grid_to_lidar = Pose::new([half, 0.0, 0.0, half], [0.0, -2.0, -1.0]).expect("a pose");
    let truth = Truth { grid_to_lidar, ..truth(vec![0; 32]) };
    // Each voxel of the prediction has a class of its own.
    let classes = 33;
    let prediction: Vec<u8> = (1..=32).collect();
    let options = Options { rings: vec![2.0] };
    let scorer = Scorer::new(classes, 1, ego, TRUTH, &options).expect("sound options");
    let support: Vec<u16> = (0..32).map(|i| u16::from(i < 2)).collect();
    let score = scorer.score(&truth, &Prediction { support: Some(&support), ..blind(&prediction) }).expect("a score");
    let (mut expected, mut near) = (vec![0; classes], 0);
    for (x, y, z) in (0..32usize).map(|i| (i / 8, i / 2 % 4, i % 2)) {
        // Centres are at -3, -1, 1, 3 m, in layers at -0.5 and 0.5 m, of which only the upper stays inside.
        let [ego_x, ego_y] = [x, y].map(|i| 2 * i as i32 - 3);
        let (lidar_x, lidar_y) = (-ego_y, ego_x - 2);
        let index = |metres: i32| (metres + 4) / 2;
        let inside = lidar_y > -4 && z == 1;
        let at = if inside { 1 + 8 * index(lidar_x) + 2 * index(lidar_y) } else { 0 };
        expected[at as usize] += 1;
        near += u64::from(lidar_x * lidar_x + lidar_y * lidar_y < 4);
    }
    assert_eq!((0..classes).map(|class| score.region(0).count(0, class)).collect::<Vec<u64>>(), expected);
    assert_eq!((score.regions[0][0].voxels(), near), (8, 8), "rings are around the lidar");
    assert_eq!(score.region(2).voxels(), 1, "the lowest corner is a label's, what is above it is not");

    // A prediction with the axes of the labels is compared voxel by voxel, whatever the pose.
    let shared = Scorer::new(classes, 1, ego, ego, &options).expect("sound options");
    let score = shared.score(&truth, &blind(&prediction)).expect("a score");
    assert!((1..classes).all(|class| score.region(0).count(0, class) == 1));
    assert_eq!(score.regions[0][0].voxels(), 8);
    let error = Scorer::new(classes, 1, TRUTH, ego, &options).expect_err("no way from the lidar to the vehicle");
    assert!(error.message().contains("axes of the ego vehicle"), "{error}");
    // Losses are of the network's own voxels.
    let logits = vec![0.0; 32 * classes];
    let error = scorer.score(&truth, &Prediction { logits: Some(&logits), ..blind(&prediction) });
    assert!(error.expect_err("other voxels").message().starts_with("losses need labels on the grid"));
}
