//! Takes what the workers of a phase record, and makes steps of it.

use std::time::Duration;

use indicatif::ProgressBar;

use super::{outcome::Step, record::Tally, table, worker::Task};

/// The time after a step at which it is shown.
pub(super) const LAG: Duration = Duration::from_millis(50);

/// Takes what the workers of a phase have recorded, step by step.
pub(super) struct Collector<'a> {
    pub(super) task: &'a Task,
    /// The number of the phase, from 0.
    pub(super) phase: usize,
    /// The time of the phases before this one.
    pub(super) offset: Duration,
    /// The length of a step.
    pub(super) width: Duration,
    pub(super) tally: &'a mut Tally,
    pub(super) steps: &'a mut Vec<Step>,
    /// The place of the phase's first step.
    pub(super) first: usize,
    pub(super) line: &'a ProgressBar,
}

impl Collector<'_> {
    /// Takes the steps that are over at a time from the beginning of the phase.
    pub(super) fn collect(&mut self, now: Duration) {
        let end = self.task.recorder.step_at(now);
        self.take(end);
        if let Some(step) = self.steps[self.first..].last() {
            let line = table::progress(&self.task.phase, now, step);
            self.line.set_message(line);
        }
    }

    /// Takes the rest of a phase that has ended. Its last step is a part of the one before if it is a splinter of one.
    pub(super) fn last(&mut self) {
        const SPLINTER: Duration = Duration::from_millis(250);
        let elapsed = self.task.elapsed(true);
        let end = self.task.recorder.step_at(elapsed);
        let rest = elapsed.saturating_sub(self.width * end);
        let is_splinter = end > 0 && rest < SPLINTER;
        self.take(if is_splinter { end } else { end + 1 });
        for tally in self.task.recorder.drain(u32::MAX).into_values() {
            self.add(end.saturating_sub(1), &tally);
        }
        if let Some(step) = self.steps[self.first..].last_mut() {
            let width = if is_splinter { self.width + rest } else { rest };
            step.width = width.max(Duration::from_nanos(1));
        }
    }

    /// Takes the steps before `end`, also those in which no call ended.
    fn take(&mut self, end: u32) {
        let drained = self.task.recorder.drain(end);
        let mut next = (self.steps.len() - self.first) as u32;
        for (number, tally) in drained {
            // A worker that was not run for a while records into a step that was taken.
            if number < next {
                self.add(number, &tally);
                continue;
            }
            while next < number {
                self.push(&Tally::default());
                next += 1;
            }
            self.push(&tally);
            next += 1;
        }
        while next < end {
            self.push(&Tally::default());
            next += 1;
        }
    }

    fn push(&mut self, tally: &Tally) {
        let number = (self.steps.len() - self.first) as u32;
        let start = self.offset + self.width * number;
        self.steps
            .push(Step::of(tally, self.phase, start, self.width));
        self.tally.add(tally);
    }

    /// Adds calls to a step that was taken.
    fn add(&mut self, number: u32, tally: &Tally) {
        if let Some(step) = self.steps.get_mut(self.first + number as usize) {
            step.add(tally);
        }
        self.tally.add(tally);
    }
}
