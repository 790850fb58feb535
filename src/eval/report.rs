//! A total in words: text for a terminal, Markdown, JSON.

use super::losses::Losses;
use super::ray_iou::THRESHOLDS;
use super::table::{Table, percent};
use super::{Confusion, Published, Score, reliability};
use serde_json::{Value, json};

/// A total with the names of what it counts.
#[derive(Clone, Debug)]
pub struct Report<'a> {
    /// What was scored on what, for people.
    pub title: &'a str,
    /// Names of the classes, the empty one first.
    pub classes: &'a [&'a str],
    /// Names of the regions ([`Scorer::regions`](super::Scorer::regions)).
    pub regions: &'a [&'a str],
    /// Ends of the rings in metres, as in [`Options::rings`](super::Options::rings).
    pub rings: &'a [f64],
    /// How the set's own evaluation is counted, if it is ([`Scorer::published`](super::Scorer::published)).
    pub published: Option<Published>,
    /// Frames scored.
    pub frames: usize,
    /// Their sum.
    pub total: &'a Score,
    /// Of what was predicted in them ([`FrameScore::digests`](super::FrameScore::digests) of a total).
    pub digest: u64,
}

impl Report<'_> {
    /// IoU, mIoU and every class as a table of lines for a terminal, then IoU and mIoU by distance.
    pub fn text(&self) -> String {
        let tables: Vec<String> = self.tables().iter().map(Table::text).collect();
        format!("{}, {} frames\n\n{}", self.title, self.frames, tables.join("\n"))
    }

    /// The same tables as Markdown.
    pub fn markdown(&self) -> String {
        let tables: Vec<String> = self.tables().iter().map(Table::markdown).collect();
        format!("{}, {} frames. IoU in per cent.\n\n{}", self.title, self.frames, tables.join("\n"))
    }

    /// All ratios and counts. Ratios are from 0 to 1; one that is 0 / 0 is null.
    pub fn json(&self) -> Value {
        let regions: serde_json::Map<String, Value> = self
            .regions
            .iter()
            .enumerate()
            .map(|(index, &name)| {
                let rings: serde_json::Map<String, Value> = self
                    .ring_names()
                    .into_iter()
                    .zip(&self.total.regions[index])
                    .map(|(n, c)| (n, self.ratios(c)))
                    .collect();
                let whole = self.total.region(index);
                let mut value = self.ratios(&whole);
                value["rings"] = Value::Object(rings);
                value["confusion"] = json!(whole.counts().chunks(whole.classes()).collect::<Vec<_>>());
                (name.to_owned(), value)
            })
            .collect();
        let rays = &self.total.rays;
        let ray_classes: serde_json::Map<String, Value> = (1..self.classes.len())
            .map(|c| (self.classes[c].to_owned(), json!([0, 1, 2].map(|t| rays.class_iou(t, c)))))
            .collect();
        let ray_means = [0, 1, 2].map(|t| rays.mean(t));
        let losses = self.total.losses.mean().map(|Losses { focal, lovasz, geometric, semantic }| {
            json!({ "focal": focal, "lovasz": lovasz, "geometric": geometric, "semantic": semantic })
        });
        json!({
            "title": self.title,
            "frames": self.frames,
            "digest": format!("{:016x}", self.digest),
            "classes": self.classes,
            "regions": regions,
            "published": self.published(),
            "ray_iou": {
                "mean": rays.ray_iou(),
                "thresholds": THRESHOLDS,
                "means": ray_means,
                "classes": ray_classes,
            },
            "losses": losses,
            "calibration": self.is_calibrated().then(|| reliability::json(self.regions, &self.total.calibration)),
        })
    }

    /// Whether anything is known of how sure the network may be.
    fn is_calibrated(&self) -> bool {
        self.total.calibration.iter().any(|calibration| calibration.occupied.voxels() > 0)
    }

    fn ratios(&self, confusion: &Confusion) -> Value {
        let classes: serde_json::Map<String, Value> = self
            .classes
            .iter()
            .enumerate()
            .map(|(class, &name)| {
                let hits = confusion.count(class, class);
                let value = json!({
                    "iou": confusion.class_iou(class),
                    "labelled": confusion.labelled(class),
                    "predicted": confusion.predicted(class),
                    "hits": hits,
                });
                (name.to_owned(), value)
            })
            .collect();
        json!({
            "iou": confusion.iou(),
            "miou": confusion.mean_iou(),
            "accuracy": confusion.accuracy(),
            "voxels": confusion.voxels(),
            "classes": classes,
        })
    }

    fn published(&self) -> Value {
        let (Some(published), counts) = (self.published, &self.total.published) else { return Value::Null };
        let names = self.classes.iter().copied().chain(["others"]);
        let classes: serde_json::Map<String, Value> =
            names.enumerate().skip(1).map(|(class, name)| (name.to_owned(), json!(counts.class_iou(class)))).collect();
        json!({
            "name": published.name(),
            "miou": published.mean_iou(counts),
            "iou": counts.iou(),
            "voxels": counts.voxels(),
            "classes": classes,
        })
    }

    fn ring_names(&self) -> Vec<String> {
        let starts = std::iter::once(0.0).chain(self.rings.iter().copied());
        let mut names: Vec<String> = starts.zip(self.rings).map(|(start, end)| format!("{start}-{end} m")).collect();
        names.push(match self.rings.last() {
            Some(end) => format!("beyond {end} m"),
            None => "everywhere".to_owned(),
        });
        names
    }

    fn tables(&self) -> Vec<Table> {
        let iou = self.by_ring("IoU", Confusion::iou);
        let mean = self.by_ring("mIoU", Confusion::mean_iou);
        let mut tables = vec![self.by_class(), iou, mean, self.by_threshold()];
        tables.extend(self.published.map(|published| {
            let counts = &self.total.published;
            let head = ["as published", "mIoU", "IoU"].map(str::to_owned).to_vec();
            let values = [published.mean_iou(counts), counts.iou()].map(percent);
            Table { head, rows: vec![std::iter::once(published.name().to_owned()).chain(values).collect()] }
        }));
        tables.extend(self.total.losses.mean().map(|losses| {
            let values = [losses.focal, losses.lovasz, losses.geometric, losses.semantic];
            let head = ["loss", "focal", "lovasz", "geometric", "semantic"].map(str::to_owned).to_vec();
            let row = std::iter::once("level 0".to_owned()).chain(values.map(|value| format!("{value:.4}"))).collect();
            Table { head, rows: vec![row] }
        }));
        if self.is_calibrated() {
            tables.extend(reliability::tables(self.regions, &self.total.calibration));
        }
        tables
    }

    fn by_threshold(&self) -> Table {
        let rays = &self.total.rays;
        let thresholds = THRESHOLDS.map(|metres| format!("{metres} m"));
        let head = ["RayIoU".to_owned(), "mean".to_owned()].into_iter().chain(thresholds).collect();
        let means = [rays.ray_iou(), rays.mean(0), rays.mean(1), rays.mean(2)].map(percent);
        Table { head, rows: vec![std::iter::once("all".to_owned()).chain(means).collect()] }
    }

    /// A column for each region; the share of the labelled voxels beside.
    fn by_class(&self) -> Table {
        let regions: Vec<Confusion> = (0..self.regions.len()).map(|r| self.total.region(r)).collect();
        let row = |name: &str, share: String, value: &dyn Fn(&Confusion) -> Option<f64>| {
            let cells = regions.iter().map(|region| percent(value(region)));
            [name.to_owned(), share].into_iter().chain(cells).collect()
        };
        let mut rows: Vec<Vec<String>> =
            vec![row("IoU", String::new(), &Confusion::iou), row("mIoU", String::new(), &Confusion::mean_iou)];
        let occupied = regions[0].voxels() - regions[0].labelled(0);
        for (class, name) in self.classes.iter().enumerate().skip(1) {
            let share = regions[0].labelled(class) as f64 / occupied.max(1) as f64;
            rows.push(row(name, format!("{:.3}", 100.0 * share), &|region| region.class_iou(class)));
        }
        let head = ["", "share"].iter().chain(self.regions).map(|&s| s.to_owned()).collect();
        Table { head, rows }
    }

    /// A row for each region, a column for each ring.
    fn by_ring(&self, name: &str, value: impl Fn(&Confusion) -> Option<f64>) -> Table {
        let head = [name.to_owned(), "all".to_owned()].into_iter().chain(self.ring_names()).collect();
        let row = |(index, region): (usize, &&str)| {
            let rings = self.total.regions[index].iter().map(|ring| percent(value(ring)));
            [(*region).to_owned(), percent(value(&self.total.region(index)))].into_iter().chain(rings).collect()
        };
        Table { head, rows: self.regions.iter().enumerate().map(row).collect() }
    }
}
