//! Two predictors on the same frames: who is better at what, and how often they say the same.

use super::table::{Table, percent};
use super::{Confusion, FrameScore};
use serde_json::{Value, json};

/// The totals of two predictors with the names of what they count.
#[derive(Clone, Debug)]
pub struct Comparison<'a> {
    /// Names of the two.
    pub names: [&'a str; 2],
    /// What they were scored on.
    pub data: &'a str,
    /// Names of the classes, the empty one first.
    pub classes: &'a [&'a str],
    /// Frames scored.
    pub frames: usize,
    /// Their sums, of all voxels of the first region ("all").
    pub scores: [&'a Confusion; 2],
    /// Classes of the first, taken for classes of the second.
    pub agreement: &'a Confusion,
}

impl<'a> Comparison<'a> {
    /// The comparison that `totals` holds, given the sums of their first regions; none if they are not of two predictors.
    pub fn of(
        names: [&'a str; 2],
        data: &'a str,
        classes: &'a [&'a str],
        frames: usize,
        sums: &'a [Confusion],
        totals: &'a FrameScore,
    ) -> Option<Self> {
        let [first, second] = sums else { return None };
        let agreement = totals.agreement.as_ref()?;
        Some(Self { names, data, classes, frames, scores: [first, second], agreement })
    }

    /// A table of lines for a terminal: IoU, mIoU and every class of both, the difference, and the IoU of the one with the
    /// other.
    pub fn text(&self) -> String {
        format!("{}\n\n{}\n{}\n", self.heading(), self.table().text(), self.summary())
    }

    /// The same as Markdown.
    pub fn markdown(&self) -> String {
        format!("{}. IoU in per cent.\n\n{}\n{}\n", self.heading(), self.table().markdown(), self.summary())
    }

    /// The same ratios, from 0 to 1; one that is 0 / 0 is null.
    pub fn json(&self) -> Value {
        let row = |value: &dyn Fn(&Confusion) -> Option<f64>| {
            let [first, second] = self.scores.map(value);
            json!({
                "first": first,
                "second": second,
                "difference": first.zip(second).map(|(first, second)| second - first),
                "agreement": value(self.agreement),
            })
        };
        let classes: serde_json::Map<String, Value> = (1..self.classes.len())
            .map(|class| (self.classes[class].to_owned(), row(&|c| c.class_iou(class))))
            .collect();
        json!({
            "first": self.names[0],
            "second": self.names[1],
            "data": self.data,
            "frames": self.frames,
            "equal": self.agreement.accuracy(),
            "voxels": self.agreement.voxels(),
            "iou": row(&Confusion::iou),
            "miou": row(&Confusion::mean_iou),
            "classes": classes,
        })
    }

    fn heading(&self) -> String {
        let [first, second] = self.names;
        format!("A: {first}\nB: {second}\non {}, {} frames", self.data, self.frames)
    }

    fn summary(&self) -> String {
        let voxels = self.agreement.voxels();
        let equal: u64 = (0..self.classes.len()).map(|class| self.agreement.count(class, class)).sum();
        let different = voxels - equal;
        format!(
            "A and B say the same of {} % of {voxels} voxels, {different} differ",
            percent(self.agreement.accuracy())
        )
    }

    fn table(&self) -> Table {
        let row = |name: &str, value: &dyn Fn(&Confusion) -> Option<f64>| {
            let [first, second] = self.scores.map(value);
            let difference = first.zip(second).map_or("-".to_owned(), |(a, b)| format!("{:+.2}", 100.0 * (b - a)));
            vec![name.to_owned(), percent(first), percent(second), difference, percent(value(self.agreement))]
        };
        let mut rows = vec![row("IoU", &Confusion::iou), row("mIoU", &Confusion::mean_iou)];
        for (class, name) in self.classes.iter().enumerate().skip(1) {
            rows.push(row(name, &|confusion| confusion.class_iou(class)));
        }
        Table { head: ["", "A", "B", "B - A", "IoU of A with B"].map(str::to_owned).to_vec(), rows }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn differences_and_agreement_by_hand() {
        // Truth 1 1 1 0, A says 1 1 0 0, B says 1 1 1 2.
        let of = |pairs: [(u8, u8); 4]| {
            let mut confusion = Confusion::new(3);
            pairs.iter().for_each(|&(a, b)| confusion.add(a, b));
            confusion
        };
        let sums = [of([(1, 1), (1, 1), (1, 0), (0, 0)]), of([(1, 1), (1, 1), (1, 1), (0, 2)])];
        let totals =
            FrameScore { digests: vec![], scores: vec![], agreement: Some(of([(1, 1), (1, 1), (0, 1), (0, 2)])) };
        let classes = ["empty", "car", "bus"];
        let comparison = Comparison::of(["a", "b"], "set", &classes, 1, &sums, &totals).expect("two");
        let json = comparison.json();
        assert_eq!(json["equal"], 0.5);
        assert_eq!(json["classes"]["car"]["first"], 2.0 / 3.0);
        assert_eq!(json["classes"]["car"]["second"], 1.0);
        assert_eq!(json["classes"]["car"]["difference"], 1.0 - 2.0 / 3.0);
        assert_eq!(json["classes"]["car"]["agreement"], 2.0 / 3.0);
        assert_eq!(json["classes"]["bus"]["first"], Value::Null);
        assert_eq!(json["classes"]["bus"]["second"], 0.0);
        let text = comparison.text();
        assert!(text.contains("car   66.67  100.00  +33.33            66.67"), "{text}");
        assert!(text.contains("same of 50.00 % of 4 voxels, 2 differ"), "{text}");
        assert!(comparison.markdown().contains("| bus | - | 0.00 | - | 0.00 |"), "{}", comparison.markdown());
        assert!(Comparison::of(["a", "b"], "set", &classes, 1, &sums[..1], &totals).is_none());
    }
}
