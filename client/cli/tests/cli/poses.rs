//! States of SE(3).

pub(crate) const SPACE: &str = "R3*SO3:0.15";

/// The pose with this number; no two are equal.
pub(crate) fn pose(number: u64) -> [f64; 7] {
    // Powers of one fraction, whose multiples fill a cube evenly.
    let at = |power| (number as f64 * 0.911_f64.powi(power)).fract();
    let [a, b, c, d] = [4, 5, 6, 7].map(|power| at(power) - 0.5);
    let norm = (a * a + b * b + c * c + d * d).sqrt();
    [at(1), at(2), at(3), a / norm, b / norm, c / norm, d / norm]
}
