//! Scales of charts, and their ticks.

/// A linear scale from 0, or a logarithmic one, over the pixels from `from` to `to`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Scale {
    low: f64,
    high: f64,
    from: f64,
    to: f64,
    is_log: bool,
}

impl Scale {
    pub(super) fn linear(high: f64, from: f64, to: f64) -> Scale {
        Scale {
            low: 0.0,
            high,
            from,
            to,
            is_log: false,
        }
    }

    /// A scale whose ends are 1, 2 or 5 times a power of ten and hold `low` and `high`, which are above 0.
    pub(super) fn logarithmic(low: f64, high: f64, from: f64, to: f64) -> Scale {
        let below = round_numbers(low / 10.0).rfind(|number| *number <= low);
        let above = round_numbers(high).find(|number| *number >= high);
        let (low, high) = (below.unwrap_or(low), above.unwrap_or(high));
        Scale {
            low,
            high: if high > low { high } else { low * 10.0 },
            from,
            to,
            is_log: true,
        }
    }

    /// The pixel of a value.
    pub(super) fn at(&self, value: f64) -> f64 {
        let place = |value: f64| if self.is_log { value.log10() } else { value };
        let value = value.clamp(self.low, self.high);
        let share = (place(value) - place(self.low)) / (place(self.high) - place(self.low));
        self.from + share * (self.to - self.from)
    }

    /// Round numbers on the scale, about `count` of them.
    pub(super) fn ticks(&self, count: usize) -> Vec<f64> {
        if !self.is_log {
            let step = step(self.high / count.max(1) as f64);
            let last = (self.high / step + 1e-9).floor() as usize;
            return (0..=last).map(|tick| tick as f64 * step).collect();
        }
        let is_inside = |number: &f64| (self.low..=self.high * (1.0 + 1e-9)).contains(number);
        let decades = (self.high / self.low).log10();
        // All of 1, 2, 5 over few decades, else powers of ten alone.
        let all = round_numbers(self.low / 10.0).take_while(|number| *number <= self.high * 1.01);
        let all = all.filter(is_inside);
        match decades > 2.5 {
            true => all.filter(|number| is_power_of_ten(*number)).collect(),
            false => all.collect(),
        }
    }
}

/// The numbers 1, 2, 5, 10, 20 and so on, from the greatest power of ten below `low`, over 16 decades.
fn round_numbers(low: f64) -> impl DoubleEndedIterator<Item = f64> {
    let first = low.log10().floor() as i32;
    (first..first + 16).flat_map(|power| [1.0, 2.0, 5.0].map(|digit| digit * 10_f64.powi(power)))
}

fn is_power_of_ten(number: f64) -> bool {
    let power = number.log10();
    (power - power.round()).abs() < 1e-6
}

/// The least of 1, 2, 5 times a power of ten that is not below `least`.
pub(super) fn step(least: f64) -> f64 {
    match least > 0.0 {
        true => round_numbers(least)
            .find(|number| *number >= least * (1.0 - 1e-9))
            .unwrap_or(least),
        false => 1.0,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn near(found: &[f64], expected: &[f64]) {
        assert_eq!(found.len(), expected.len(), "{found:?}");
        for (found, expected) in found.iter().zip(expected) {
            assert!(
                (found / expected - 1.0).abs() < 1e-9 || found == expected,
                "{found}"
            );
        }
    }

    #[test]
    fn ticks_are_round_numbers() {
        near(
            &Scale::linear(10.0, 0.0, 100.0).ticks(5),
            &[0.0, 2.0, 4.0, 6.0, 8.0, 10.0],
        );
        near(
            &Scale::linear(47.0, 0.0, 100.0).ticks(5),
            &[0.0, 10.0, 20.0, 30.0, 40.0],
        );
        let scale = Scale::logarithmic(1.3e5, 4.0e6, 0.0, 100.0);
        near(&scale.ticks(5), &[1e5, 2e5, 5e5, 1e6, 2e6, 5e6]);
        let scale = Scale::logarithmic(1.0e3, 1.0e7, 0.0, 100.0);
        near(&scale.ticks(5), &[1e3, 1e4, 1e5, 1e6, 1e7]);
        near(
            &[step(0.0), step(0.3), step(7.0), step(200.0)],
            &[1.0, 0.5, 10.0, 200.0],
        );
    }

    #[test]
    fn values_have_their_places_and_do_not_leave_the_chart() {
        let scale = Scale::logarithmic(10.0, 1000.0, 0.0, 100.0);
        for (value, place) in [
            (10.0, 0.0),
            (100.0, 50.0),
            (1000.0, 100.0),
            (0.0, 0.0),
            (1e9, 100.0),
        ] {
            assert!(
                (scale.at(value) - place).abs() < 1e-9,
                "{value}: {}",
                scale.at(value)
            );
        }
        // Equal ends make a decade.
        let scale = Scale::logarithmic(100.0, 100.0, 0.0, 100.0);
        assert!(scale.at(100.0).is_finite());
        assert!((Scale::linear(8.0, 100.0, 0.0).at(2.0) - 75.0).abs() < 1e-9);
    }
}
