//! Watermarks of memory and disk: above the high one the server takes in nothing that grows it, until the use falls to
//! the low one. Reads, removals and deletions go on.
//!
//! The use is measured when it is needed, at most once in 100 ms or once per MiB taken in. One thread measures at a time, and
//! the others use the last measurement meanwhile: a disk that does not answer stops one thread only.

mod disk;
mod memory;

use std::{
    fmt, io,
    sync::{
        Arc,
        atomic::{AtomicU64, Ordering::Relaxed},
    },
    time::{Duration, Instant},
};

use parking_lot::{Mutex, MutexGuard};
use thiserror::Error;
use tracing::{info, warn};

pub use disk::disk;
pub use memory::memory;
pub(crate) use memory::{limit as memory_limit, release_if_grown, release_to_os};

/// The time between two measurements.
const INTERVAL: Duration = Duration::from_millis(100);

/// Merges have this part of the limit at least. Above the high watermark of memory there is room for it.
const MERGE_PARTS: u64 = 16;

/// The use is measured again after this many bytes were taken in.
const MAX_UNMEASURED_BYTES: u64 = 1024 * 1024;

/// A resource with a watermark.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Resource {
    /// The memory of the process.
    Memory,
    /// The disk of the data directory.
    Disk,
}

impl Resource {
    /// Its name in texts and metrics.
    fn name(self) -> &'static str {
        match self {
            Self::Memory => "memory",
            Self::Disk => "disk",
        }
    }

    /// The setting of its high watermark.
    pub fn setting(self) -> &'static str {
        match self {
            Self::Memory => "memory.high_percent",
            Self::Disk => "disk.min_free_bytes",
        }
    }

    /// The reason of a refusal, in UPPER_SNAKE_CASE.
    pub(crate) fn reason(self) -> &'static str {
        match self {
            Self::Memory => "MEMORY_FULL",
            Self::Disk => "DISK_FULL",
        }
    }
}

impl fmt::Display for Resource {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// A measurement: the used bytes, and the watermarks that apply to them.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Usage {
    /// The used bytes.
    pub used: u64,
    /// The watermark above which growth is refused.
    pub high: u64,
    /// The watermark from which growth is accepted again.
    pub low: u64,
    /// The bytes that there are.
    pub limit: u64,
}

/// The refusal of growth.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Error)]
#[error(
    "{used} of {limit} bytes of {resource} would be used, and growth is refused above {high} until {low} ({})",
    resource.setting()
)]
pub struct WatermarkExceeded {
    /// The resource.
    pub resource: Resource,
    /// The used bytes, with those that were refused.
    pub used: u64,
    /// The high watermark.
    pub high: u64,
    /// The low watermark.
    pub low: u64,
    /// The bytes that there are.
    pub limit: u64,
}

/// Measures a resource.
type Probe = dyn Fn() -> io::Result<Usage> + Send + Sync;

/// A watermark of one resource.
pub struct Watermark {
    resource: Resource,
    probe: Box<Probe>,
    interval: Duration,
    /// The bytes below the limit that are kept for calls.
    reserved: u64,
    state: Mutex<State>,
    /// Held by the thread that measures.
    measuring: Mutex<()>,
    /// The calls that were refused for it.
    refused: AtomicU64,
}

#[derive(Default)]
struct State {
    measured: Option<(Instant, Usage)>,
    /// The bytes taken in since the measurement.
    added: u64,
    is_closed: bool,
}

impl Watermark {
    /// A watermark of `resource`, which `probe` measures.
    pub fn new(
        resource: Resource,
        probe: impl Fn() -> io::Result<Usage> + Send + Sync + 'static,
    ) -> Self {
        Self {
            resource,
            probe: Box::new(probe),
            interval: INTERVAL,
            reserved: 0,
            state: Mutex::default(),
            measuring: Mutex::default(),
            refused: AtomicU64::new(0),
        }
    }

    /// The same watermark, with another time between two measurements.
    pub fn measured_every(self, interval: Duration) -> Self {
        Self { interval, ..self }
    }

    /// The same watermark, which keeps these bytes below the limit for calls.
    pub(crate) fn reserving(self, reserved: u64) -> Self {
        Self { reserved, ..self }
    }

    /// Takes in about `bytes` more, or refuses them. A resource without a measurement refuses nothing.
    pub fn admit(&self, bytes: u64) -> Result<(), WatermarkExceeded> {
        let mut state = self.measured();
        let Some((_, level)) = state.measured else {
            return Ok(());
        };
        let after = level.used + state.added + bytes;
        if state.is_closed || after > level.high {
            return Err(self.full(&level, after));
        }
        state.added += bytes;
        Ok(())
    }

    /// Fails if a start that takes `bytes` more comes too near to the limit. It may pass the high watermark by half of
    /// what is above: all that was taken in below it has to fit again. It measures every time.
    pub fn fits_at_start(&self, bytes: u64) -> Result<(), WatermarkExceeded> {
        let Ok(mut level) = (self.probe)() else {
            return Ok(());
        };
        level.high += level.limit.saturating_sub(level.high) / 2;
        let used = level.used + bytes;
        match used > level.high {
            true => Err(self.full(&level, used)),
            false => Ok(()),
        }
    }

    /// The bytes for merges: up to the limit, above the watermarks too, without those that are kept for calls, or their own
    /// part if that is more: what calls hold is in the use too. None if the resource cannot be measured.
    pub fn remaining(&self) -> Option<u64> {
        let state = self.measured();
        let (_, level) = state.measured?;
        let free = level.limit.saturating_sub(level.used + state.added);
        let own = free.min(level.limit / MERGE_PARTS);
        Some(free.saturating_sub(self.reserved).max(own))
    }

    /// The resource now; None if it cannot be measured.
    pub(crate) fn now(&self) -> Option<Usage> {
        (self.probe)().ok()
    }

    /// The bytes that there are; None if the resource cannot be measured.
    pub fn limit(&self) -> Option<u64> {
        Some((self.probe)().ok()?.limit)
    }

    /// The state with the newest measurement, or with a new one if it is due and no other thread measures.
    fn measured(&self) -> MutexGuard<'_, State> {
        let mut state = self.state.lock();
        if let Some((at, _)) = state.measured
            && at.elapsed() < self.interval
            && state.added < MAX_UNMEASURED_BYTES
        {
            return state;
        }
        let Some(_measuring) = self.measuring.try_lock() else {
            return state;
        };
        let added = state.added;
        let measured = MutexGuard::unlocked(&mut state, || (self.probe)());
        // The measurement may lack the bytes that other threads took in meanwhile.
        state.added -= added;
        self.note(&mut state, measured);
        state
    }

    fn note(&self, state: &mut State, measured: io::Result<Usage>) {
        let resource = self.resource;
        let level = match measured {
            Ok(level) => level,
            Err(error) => {
                if state.measured.take().is_some() {
                    warn!(%resource, %error, "cannot measure it any more: nothing is refused for it");
                }
                state.is_closed = false;
                return;
            }
        };
        let Usage {
            used, high, low, ..
        } = level;
        if !state.is_closed && used > high {
            warn!(%resource, used, high, low, "above the high watermark: growth is refused");
            state.is_closed = true;
        } else if state.is_closed && used <= low {
            info!(%resource, used, high, low, "below the low watermark: growth is accepted again");
            state.is_closed = false;
        }
        state.measured = Some((Instant::now(), level));
    }

    fn full(&self, level: &Usage, used: u64) -> WatermarkExceeded {
        WatermarkExceeded {
            resource: self.resource,
            used,
            high: level.high,
            low: level.low,
            limit: level.limit,
        }
    }
}

/// The watermarks of a server.
#[derive(Clone, Default)]
pub struct Watermarks {
    /// The memory of the process.
    pub memory: Option<Arc<Watermark>>,
    /// The disk of the data directory.
    pub disk: Option<Arc<Watermark>>,
}

impl Watermarks {
    fn all(&self) -> impl Iterator<Item = &Arc<Watermark>> {
        [&self.memory, &self.disk].into_iter().flatten()
    }

    /// Takes in about `bytes` more of a call, or refuses and counts it.
    pub fn admit(&self, bytes: u64) -> Result<(), WatermarkExceeded> {
        self.all().try_for_each(|it| {
            let admitted = it.admit(bytes);
            if admitted.is_err() {
                it.refused.fetch_add(1, Relaxed);
            }
            admitted
        })
    }

    /// Fails if a call that grows the server would be refused now.
    pub(crate) fn check(&self) -> Result<(), WatermarkExceeded> {
        self.all().try_for_each(|it| it.admit(0))
    }

    /// The measurements of the resources that can be measured, by name.
    pub(crate) fn levels(&self) -> Vec<(&'static str, Usage)> {
        let named = |it: &Arc<Watermark>| Some((it.resource.name(), it.now()?));
        self.all().filter_map(named).collect()
    }

    /// The numbers of calls that were refused so far, by reason.
    pub(crate) fn refused(&self) -> Vec<(&'static str, u64)> {
        let counted = |it: &Arc<Watermark>| (it.resource.reason(), it.refused.load(Relaxed));
        self.all().map(counted).collect()
    }
}

#[cfg(test)]
mod tests {
    use std::{sync::mpsc, thread};

    use super::*;

    /// The time in which a thread that is not stopped answers.
    const ANSWERS: Duration = Duration::from_secs(10);

    #[test]
    fn merges_leave_the_bytes_of_calls() {
        let of = |used| {
            let probe = move || {
                Ok(Usage {
                    used,
                    high: 70,
                    low: 60,
                    limit: 160,
                })
            };
            Watermark::new(Resource::Memory, probe)
                .reserving(40)
                .remaining()
        };
        assert_eq!([of(50), of(115), of(155)], [Some(70), Some(10), Some(5)]);
    }

    #[test]
    fn a_disk_that_does_not_answer_stops_one_thread() {
        let (starts, started) = mpsc::channel();
        let (answers, answered) = mpsc::channel::<u64>();
        let answered = Mutex::new(answered);
        let probe = move || {
            starts.send(()).unwrap();
            Ok(Usage {
                used: answered.lock().recv().unwrap(),
                high: 85,
                low: 80,
                limit: 100,
            })
        };
        let disk = Watermark::new(Resource::Disk, probe).measured_every(Duration::ZERO);
        let disk = Arc::new(disk);
        answers.send(50).unwrap();
        disk.admit(10).unwrap();
        started.recv().unwrap();
        let measuring = Arc::clone(&disk);
        let measuring = thread::spawn(move || measuring.admit(1));
        started.recv().unwrap();

        let (ends, ended) = mpsc::channel();
        let others = Arc::clone(&disk);
        thread::spawn(move || {
            let admitted = [others.admit(20), others.admit(20)];
            ends.send((admitted.map(|it| it.is_ok()), others.remaining()))
        });
        // 50 were used, and 10 taken in before.
        let ended = ended.recv_timeout(ANSWERS);
        assert_eq!(ended, Ok(([true, false], Some(20))));

        // The measurement has the first 10, and maybe not the 20 after them.
        answers.send(65).unwrap();
        assert_eq!(measuring.join().unwrap().unwrap_err().used, 86);
    }
}
