//! Figures from measurements.

use std::{fs, time::Duration};

/// The median.
///
/// # Panics
/// If there are no values.
pub fn median(mut rates: Vec<f64>) -> f64 {
    rates.sort_by(f64::total_cmp);
    rates[rates.len() / 2]
}

/// A quantile, in milliseconds, of ascending durations.
pub fn quantile_ms(taken: &[Duration], q: f64) -> f64 {
    let last = taken.len().saturating_sub(1) as f64;
    let at = (last * q).round() as usize;
    taken
        .get(at)
        .map_or(f64::NAN, |taken| taken.as_secs_f64() * 1e3)
}

/// The resident memory of a process, if the system reports it.
pub fn resident_bytes(process: u32) -> Option<u64> {
    status_bytes(process, "VmRSS:")
}

/// The highest resident memory of a process since [`reset_peak`], if the system reports it.
pub fn peak_resident_bytes(process: u32) -> Option<u64> {
    status_bytes(process, "VmHWM:")
}

/// The memory that only this process holds, if the system reports it.
pub fn anonymous_bytes(process: u32) -> Option<u64> {
    status_bytes(process, "RssAnon:")
}

/// Makes [`peak_resident_bytes`] start again from the memory of now, where the system allows it.
pub fn reset_peak(process: u32) {
    let _ = fs::write(format!("/proc/{process}/clear_refs"), "5");
}

/// A line of a process's status, in bytes.
fn status_bytes(process: u32, name: &str) -> Option<u64> {
    let status = fs::read_to_string(format!("/proc/{process}/status")).ok()?;
    let line = status.lines().find_map(|line| line.strip_prefix(name))?;
    let kib: u64 = line.trim().trim_end_matches(" kB").parse().ok()?;
    Some(kib * 1024)
}

/// The processor time of a process in seconds, if the system reports it.
pub fn processor_seconds(process: u32) -> Option<f64> {
    /// The ticks of `clock_t` in /proc on Linux. They do not depend on the kernel's own ticks.
    const TICKS_PER_SECOND: f64 = 100.0;
    let stat = fs::read_to_string(format!("/proc/{process}/stat")).ok()?;
    // The preceding name may hold spaces. User and system time are the 14th and 15th field.
    let (_, fields) = stat.rsplit_once(") ")?;
    let ticks = fields.split(' ').skip(11).take(2);
    let ticks: u64 = ticks.filter_map(|field| field.parse::<u64>().ok()).sum();
    Some(ticks as f64 / TICKS_PER_SECOND)
}

/// The processor time of the threads of a process that run now, if the system reports it. Exact once they all wait.
pub fn processor_time(process: u32) -> Option<Duration> {
    let threads = fs::read_dir(format!("/proc/{process}/task")).ok()?;
    let mut nanos = 0;
    for thread in threads.filter_map(Result::ok) {
        // A thread that has just ended has no file.
        let text = fs::read_to_string(thread.path().join("schedstat")).unwrap_or_default();
        nanos += text.split(' ').next()?.parse().unwrap_or(0);
    }
    Some(Duration::from_nanos(nanos))
}
