//! A reliability diagram: what was said to be so likely, and how often it came true.

use super::canvas::{Canvas, Rect, Rgb};
use super::text::{Fonts, Weight};
use super::{GREY, INK, PAPER, Picture};

const MARGIN: usize = 56;
const SIDE: usize = 900;
const SIZE: f32 = 24.0;
const HEADING: usize = 120;
/// Room for the numbers and the name of each axis.
const AXIS: usize = 100;
/// A line of the legend.
const LINE: usize = 40;
/// Colours of curves that colour blindness leaves apart; more curves begin again.
const COLOURS: [Rgb; 4] = [[0, 95, 155], [190, 95, 0], [0, 130, 95], [160, 60, 120]];
const RULE: Rgb = [222, 225, 230];

/// What to draw.
#[derive(Clone, Copy, Debug)]
pub struct Diagram<'a> {
    /// First line, in bold.
    pub title: &'a str,
    /// Second line.
    pub subtitle: &'a str,
    /// What is drawn, each in its colour.
    pub curves: &'a [Curve],
}

/// A curve of a diagram.
#[derive(Clone, Debug, PartialEq)]
pub struct Curve {
    /// What it is of, for the legend.
    pub name: String,
    /// Its points, by what was said.
    pub points: Vec<Point>,
}

/// A point of a curve, all from 0 to 1; others, and what is not a number, are not drawn.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Point {
    /// The probability that was said.
    pub said: f32,
    /// How often it came true.
    pub found: f32,
    /// The share of all that were said to be so likely.
    pub share: f32,
}

/// Draws the diagram: the probability that was said to the right, how often it came true upwards, and the diagonal on which
/// both are equal. A point grows with its share.
pub fn draw_diagram(diagram: &Diagram<'_>) -> Picture {
    let fonts = Fonts::new();
    let (left, top) = (MARGIN + AXIS, MARGIN + HEADING);
    let legend = top + SIDE + AXIS;
    let (width, height) = (left + SIDE + MARGIN, legend + LINE * diagram.curves.len() + MARGIN);
    let mut canvas = Canvas::new(width, height, PAPER);
    let room = (width - 2 * MARGIN) as f32;
    let x = MARGIN as f32;
    let title = fonts.fit(diagram.title, 32.0, Weight::Bold, room);
    fonts.draw(&mut canvas, &title, [x, MARGIN as f32 + 32.0], 32.0, Weight::Bold, INK);
    let subtitle = fonts.fit(diagram.subtitle, SIZE, Weight::Regular, room);
    fonts.draw(&mut canvas, &subtitle, [x, MARGIN as f32 + 72.0], SIZE, Weight::Regular, GREY);

    let place = |said: f32, found: f32| [left as f32 + said * SIDE as f32, top as f32 + (1.0 - found) * SIDE as f32];
    for tenth in 0..=10 {
        let value = tenth as f32 / 10.0;
        let ([x, _], [_, y]) = (place(value, 0.0), place(0.0, value));
        canvas.fill_round([x - 1.0, top as f32, x + 1.0, (top + SIDE) as f32], 0.0, RULE, 1.0);
        canvas.fill_round([left as f32, y - 1.0, (left + SIDE) as f32, y + 1.0], 0.0, RULE, 1.0);
        if tenth % 2 == 0 {
            let text = format!("{value:.1}");
            let wide = fonts.width(&text, SIZE, Weight::Regular);
            let below = [x - wide / 2.0, (top + SIDE + 36) as f32];
            fonts.draw(&mut canvas, &text, below, SIZE, Weight::Regular, GREY);
            fonts.draw(&mut canvas, &text, [left as f32 - wide - 16.0, y + 9.0], SIZE, Weight::Regular, GREY);
        }
    }
    line(&mut canvas, place(0.0, 0.0), place(1.0, 1.0), 2.0, GREY);
    let says = "probability that was said";
    let wide = fonts.width(says, SIZE, Weight::Regular);
    let under = [(left + SIDE) as f32 - wide, (top + SIDE + 72) as f32];
    fonts.draw(&mut canvas, says, under, SIZE, Weight::Regular, INK);
    fonts.draw(&mut canvas, "how often it came true", [x, top as f32 - 14.0], SIZE, Weight::Regular, INK);

    let inside = |point: &&Point| [point.said, point.found, point.share].iter().all(|v| (0.0..=1.0).contains(v));
    for (number, (curve, colour)) in diagram.curves.iter().zip(COLOURS.iter().cycle()).enumerate() {
        let points: Vec<&Point> = curve.points.iter().filter(inside).collect();
        for pair in points.windows(2) {
            let [from, to] = [pair[0], pair[1]].map(|point| place(point.said, point.found));
            line(&mut canvas, from, to, 3.0, *colour);
        }
        for point in points {
            // The fourth root, so that a thousandth of all is still seen; a logarithm is not the same on every machine.
            let size = point.share.sqrt().sqrt();
            disc(&mut canvas, place(point.said, point.found), 4.0 + 12.0 * size, *colour);
        }
        let y = (legend + number * LINE) as f32;
        disc(&mut canvas, [x + 12.0, y + 12.0], 11.0, *colour);
        let name = fonts.fit(&curve.name, SIZE, Weight::Regular, room - 40.0);
        fonts.draw(&mut canvas, &name, [x + 40.0, y + 21.0], SIZE, Weight::Regular, INK);
    }
    canvas.frame(Rect { x: left, y: top, w: SIDE, h: SIDE }, 2, GREY);
    Picture { width: canvas.width, height: canvas.height, rgb: canvas.rgb }
}

fn disc(canvas: &mut Canvas, [x, y]: [f32; 2], radius: f32, colour: Rgb) {
    canvas.fill_round([x - radius, y - radius, x + radius, y + radius], radius, colour, 1.0);
}

fn line(canvas: &mut Canvas, from: [f32; 2], to: [f32; 2], thick: f32, colour: Rgb) {
    let along = [to[0] - from[0], to[1] - from[1]];
    let length = (along[0] * along[0] + along[1] * along[1]).sqrt();
    if length > 0.0 {
        let [x, y] = along.map(|v| v / length * thick / 2.0);
        let corners =
            [[from[0] - y, from[1] + x], [from[0] + y, from[1] - x], [to[0] + y, to[1] - x], [to[0] - y, to[1] + x]];
        canvas.fill_polygon(&corners, colour, 1.0);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn pixel(picture: &Picture, x: usize, y: usize) -> Rgb {
        let at = (y * picture.width + x) * 3;
        [picture.rgb[at], picture.rgb[at + 1], picture.rgb[at + 2]]
    }

    #[test]
    fn points_lie_where_they_should_and_others_are_not_drawn() {
        let point = |said, found| Point { said, found, share: 0.5 };
        let curve = |points: &[Point]| Curve { name: "a name that is too long ".repeat(9), points: points.to_vec() };
        let curves = [curve(&[point(0.5, 0.25), point(f32::NAN, 0.5), point(0.9, 1.5)]), curve(&[])];
        let picture = draw_diagram(&Diagram { title: "", subtitle: "", curves: &curves });
        let at = |said: f32, found: f32| {
            let place = |v: f32| (v * SIDE as f32) as usize;
            pixel(&picture, MARGIN + AXIS + place(said), MARGIN + HEADING + place(1.0 - found))
        };
        assert_eq!((at(0.5, 0.25), at(0.25, 0.75)), (COLOURS[0], PAPER));
        assert_ne!(at(0.55, 0.55), PAPER, "the diagonal");
        assert!(!picture.rgb.chunks_exact(3).any(|rgb| rgb == COLOURS[2]), "two curves, two colours");
    }
}
