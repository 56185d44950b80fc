//! Watermarks of memory and disk: above the high one the server takes in nothing that grows it, until the use falls to
//! the low one. Reads, removals and deletions go on.
//!
//! The use is measured when it is needed, at most once in 100 ms or once per MiB taken in.

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

use parking_lot::Mutex;
use thiserror::Error;
use tracing::{info, warn};

pub use disk::disk;
pub use memory::memory;
pub(crate) use memory::{limit as memory_limit, release_if_grown, release_to_os};

/// The time between two measurements.
const INTERVAL: Duration = Duration::from_millis(100);

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
    state: Mutex<State>,
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
            state: Mutex::default(),
            refused: AtomicU64::new(0),
        }
    }

    /// The same watermark, with another time between two measurements.
    pub fn measured_every(self, interval: Duration) -> Self {
        Self { interval, ..self }
    }

    /// Takes in about `bytes` more, or refuses them. A resource that cannot be measured refuses nothing.
    pub fn admit(&self, bytes: u64) -> Result<(), WatermarkExceeded> {
        let mut state = self.state.lock();
        let Some(level) = self.level(&mut state) else {
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

    /// The bytes up to the limit, above the watermarks; None if the resource cannot be measured.
    pub fn remaining(&self) -> Option<u64> {
        let mut state = self.state.lock();
        let level = self.level(&mut state)?;
        Some(level.limit.saturating_sub(level.used + state.added))
    }

    /// The resource now; None if it cannot be measured.
    pub(crate) fn now(&self) -> Option<Usage> {
        (self.probe)().ok()
    }

    /// The bytes that there are; None if the resource cannot be measured.
    pub fn limit(&self) -> Option<u64> {
        Some((self.probe)().ok()?.limit)
    }

    /// The newest measurement, or a new one if it is due.
    fn level(&self, state: &mut State) -> Option<Usage> {
        if let Some((at, level)) = state.measured
            && at.elapsed() < self.interval
            && state.added < MAX_UNMEASURED_BYTES
        {
            return Some(level);
        }
        let resource = self.resource;
        let level = match (self.probe)() {
            Ok(level) => level,
            Err(error) => {
                if state.measured.take().is_some() {
                    warn!(%resource, %error, "cannot measure it any more: nothing is refused for it");
                }
                state.is_closed = false;
                return None;
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
        state.added = 0;
        Some(level)
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
