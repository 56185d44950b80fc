//! Lets a structure that knows only Euclidean space answer exactly in a space with circles, or in the rotations.
//!
//! A state is placed at its coordinates, each scaled by √μ, and an answer is the point nearest to any *image* of the
//! query. An angle θ has the image θ ± P, on the other side of the interval of the stored angles. A quaternion q has
//! the image −q, while all stored ones have w ≥ 0. So an image is outside the region of the stored points, and the
//! *gap* between the two is a lower bound on all distances found from there. An image whose gap exceeds the needed
//! distance is not searched.
//!
//! Products of a rotation with anything else have no such chart. The chord orders rotations as the angle does, but sums
//! of squares of chords have another order than sums of squares of angles.

use wayfold_index::{Factor, Space};

/// The form of a space in Euclidean coordinates.
#[derive(Clone, Debug)]
pub struct Chart {
    /// √μ of each coordinate.
    scales: Vec<f64>,
    /// The coordinates that are angles, and half of the period of each, scaled.
    circles: Vec<(usize, f64)>,
    is_rotation: bool,
}

impl Chart {
    /// The chart of a space that has one.
    pub fn of(space: &Space) -> Option<Chart> {
        let [group] = space.groups() else {
            return None;
        };
        if group.weight != 1.0 {
            return None;
        }
        let mut chart = Chart {
            scales: Vec::new(),
            circles: Vec::new(),
            is_rotation: false,
        };
        for term in &group.terms {
            let scale = term.weight.sqrt();
            match term.factor {
                Factor::RealVector(_) => {}
                Factor::SO2 { period } => {
                    let at = chart.scales.len();
                    chart.circles.push((at, scale * period / 2.0));
                }
                Factor::SO3 if group.terms.len() == 1 && scale == 1.0 => chart.is_rotation = true,
                Factor::SO3 => return None,
            }
            let coordinates = chart.scales.len() + term.factor.coordinates();
            chart.scales.resize(coordinates, scale);
        }
        Some(chart)
    }

    /// The number of coordinates of a place.
    pub fn width(&self) -> usize {
        self.scales.len()
    }

    /// The Euclidean coordinates of a state.
    pub fn place(&self, state: &[f64], place: &mut [f64]) {
        for ((at, x), scale) in place.iter_mut().zip(state).zip(&self.scales) {
            *at = x * scale;
        }
    }

    /// The squared Euclidean distance that belongs to a distance in the space.
    pub fn reach_2(&self, radius: f64) -> f64 {
        let chord = if self.is_rotation {
            2.0 * (radius.min(std::f64::consts::FRAC_PI_2) / 2.0).sin()
        } else {
            radius
        };
        chord * chord
    }

    /// Searches from each image of `place` whose gap is within the squared bound `reach_2`; `ask` returns the new
    /// bound.
    ///
    /// No point is found twice if the bound stays below half of each period, and below the chord of a right angle. The
    /// check against brute force would detect a point that is found twice.
    pub fn images(&self, place: &mut [f64], reach_2: f64, mut ask: impl FnMut(&[f64], f64) -> f64) {
        if self.is_rotation {
            let w = place[3];
            if w * w <= reach_2 {
                for x in place.iter_mut() {
                    *x = -*x;
                }
                ask(place, reach_2);
            }
        } else if !self.circles.is_empty() {
            turn(&self.circles, place, 0.0, false, reach_2, &mut ask);
        }
    }
}

/// Searches from all images that differ from `place` in some of these circles, or in none if `place` is itself an
/// image. Leaves `place` unchanged, and returns the new bound.
fn turn(
    circles: &[(usize, f64)],
    place: &mut [f64],
    gap_2: f64,
    is_image: bool,
    reach_2: f64,
    ask: &mut impl FnMut(&[f64], f64) -> f64,
) -> f64 {
    let Some((&(at, half), rest)) = circles.split_first() else {
        return if is_image {
            ask(place, reach_2)
        } else {
            reach_2
        };
    };
    let mut left_2 = turn(rest, place, gap_2, is_image, reach_2, ask);
    let angle = place[at];
    let gap = half - angle.abs();
    let gap_2 = gap_2 + gap * gap;
    if gap_2 <= left_2 {
        place[at] = angle - (2.0 * half).copysign(angle);
        left_2 = turn(rest, place, gap_2, true, left_2, ask);
        place[at] = angle;
    }
    left_2
}
