//! The retries of calls, and the pauses between them.

use std::time::Duration;

use tokio::time::Instant;
use uuid::Uuid;

use crate::Error;

/// The number of retries, and the pauses before them, of a call that failed with `UNAVAILABLE`, lost its connection, or
/// was refused by a busy server.
///
/// The client retries only calls that take effect once: reads, and mutations, which carry an operation id. The n-th
/// pause is drawn evenly from [b/2, b], where b is `first` · 2ⁿ⁻¹, at most `longest`. It is longer if the server asks for
/// a longer one. No attempt begins after the call's deadline. With several servers, the attempt after `UNAVAILABLE` goes
/// to another one.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct RetryPolicy {
    /// The most attempts, the first included.
    pub attempts: u32,
    /// The bound of the first pause.
    pub first: Duration,
    /// The bound that no pause exceeds.
    pub longest: Duration,
}

/// A longer pause that a server asks for is cut to this one, before its random part is added.
const MAX_REQUESTED_PAUSE: Duration = Duration::from_secs(60);

impl Default for RetryPolicy {
    /// Five attempts, within about a second if the server asks for no longer pause.
    fn default() -> RetryPolicy {
        RetryPolicy {
            attempts: 5,
            first: Duration::from_millis(50),
            longest: Duration::from_secs(1),
        }
    }
}

impl RetryPolicy {
    /// No retries.
    pub fn never() -> RetryPolicy {
        RetryPolicy {
            attempts: 1,
            ..RetryPolicy::default()
        }
    }

    /// Retries until the call's deadline: for programs that start together with their server.
    pub fn until_deadline() -> RetryPolicy {
        RetryPolicy {
            attempts: u32::MAX,
            ..RetryPolicy::default()
        }
    }

    /// The pause before attempt number `attempt` + 1, at a point within its range that `chance` in [0, 1] chooses;
    /// `None` if there is no such attempt.
    fn pause(&self, attempt: u32, chance: f64) -> Option<Duration> {
        if attempt >= self.attempts {
            return None;
        }
        let doublings = attempt.saturating_sub(1).min(31);
        let bound = self.first.saturating_mul(1 << doublings).min(self.longest);
        Some(bound.mul_f64(0.5 + 0.5 * chance))
    }

    /// The pause after `failures` failures in a row, the last with `error`, for retries without an end.
    pub(crate) fn endless_pause(&self, failures: u32, error: Option<&Error>) -> Duration {
        let endless = RetryPolicy {
            attempts: u32::MAX,
            ..*self
        };
        let pause = endless.pause(failures, chance()).unwrap_or(self.longest);
        pause.max(requested_pause(error))
    }

    /// Makes attempts until one succeeds, fails for good, or the next would begin after `deadline`.
    pub(crate) async fn run<T, F, Fut>(&self, deadline: Instant, mut attempt: F) -> Result<T, Error>
    where
        F: FnMut() -> Fut,
        Fut: Future<Output = Result<T, Error>>,
    {
        let mut attempts = 0;
        let mut earlier: Option<Error> = None;
        loop {
            let error = match attempt().await {
                Err(error) if error.is_transient() => error,
                done => return done.map_err(|error| error.following(earlier)),
            };
            attempts += 1;
            let next = self
                .pause(attempts, chance())
                .map(|pause| Instant::now() + pause.max(requested_pause(Some(&error))));
            let Some(next) = next.filter(|next| *next < deadline) else {
                return Err(error.following(earlier));
            };
            // The outcome stays unknown after it, whatever follows.
            if !earlier.as_ref().is_some_and(Error::may_have_taken_effect) {
                earlier = Some(error);
            }
            tokio::time::sleep_until(next).await;
        }
    }
}

/// The pause that the server asks for, lengthened by a random part of itself: refused clients do not all come back at
/// once.
fn requested_pause(error: Option<&Error>) -> Duration {
    let requested = error.and_then(Error::retry_after).unwrap_or_default();
    requested.min(MAX_REQUESTED_PAUSE).mul_f64(1.0 + chance())
}

/// A random number in [0, 1], different in each client.
fn chance() -> f64 {
    let (high, _) = Uuid::new_v4().as_u64_pair();
    high as f64 / u64::MAX as f64
}

#[cfg(test)]
mod tests {
    use tonic_types::{ErrorDetails, StatusExt};

    use super::*;
    use crate::Refusal;

    const POLICY: RetryPolicy = RetryPolicy {
        attempts: 6,
        first: Duration::from_millis(100),
        longest: Duration::from_millis(500),
    };

    #[test]
    fn pauses_double_up_to_the_longest() {
        let longest = |attempt| POLICY.pause(attempt, 1.0).map(|pause| pause.as_millis());
        let bounds: Vec<_> = (1..=6).map(longest).collect();
        assert_eq!(
            bounds,
            [Some(100), Some(200), Some(400), Some(500), Some(500), None]
        );
    }

    fn busy(pause_ms: u64) -> Error {
        let details = ErrorDetails::with_retry_info(Some(Duration::from_millis(pause_ms)));
        let busy = tonic::Code::ResourceExhausted;
        let status = tonic::Status::with_error_details(busy, "busy", details);
        Error::Refused(Box::new(Refusal::from_status(&status)))
    }

    #[tokio::test]
    async fn a_call_is_repeated_after_the_time_that_the_server_asks_for() {
        let began = Instant::now();
        let mut tries = 0;
        let attempt = || {
            tries += 1;
            std::future::ready(match tries {
                1 => Err(busy(1_000)),
                _ => Ok(()),
            })
        };
        POLICY
            .run(began + Duration::from_secs(60), attempt)
            .await
            .unwrap();
        assert!(began.elapsed() >= Duration::from_secs(1));
    }

    #[tokio::test]
    async fn a_refusal_after_a_try_of_unknown_outcome_does_not_mean_that_nothing_was_changed() {
        let end = Instant::now() + Duration::from_secs(60);
        let mut tries = 0;
        let attempt = || {
            tries += 1;
            let error = match tries {
                1 => Error::Connection {
                    call: "insert",
                    uri: "http://arm:50051".to_owned(),
                    source: "cut".into(),
                },
                2 => busy(1),
                _ => Error::Refused(Box::new(Refusal::from_status(&tonic::Status::not_found(
                    "no index",
                )))),
            };
            std::future::ready(Err::<(), _>(error))
        };
        let error = POLICY.run(end, attempt).await.unwrap_err();
        assert_eq!(error.code(), crate::Code::NotFound);
        assert!(error.may_have_taken_effect() && error.to_string().contains("cut"));
        assert!(!busy(1).may_have_taken_effect());
    }

    #[test]
    fn endless_tries_wait_as_long() {
        assert!(POLICY.endless_pause(1, Some(&busy(20_000))) >= Duration::from_secs(20));
    }

    #[test]
    fn they_are_spread() {
        let pauses = (0..20).map(|_| requested_pause(Some(&busy(20_000))));
        let pauses: std::collections::BTreeSet<_> = pauses.collect();
        assert!(pauses.len() > 1);
    }

    #[test]
    fn chance_shortens_a_pause_by_half_at_most() {
        assert_eq!(POLICY.pause(1, 0.0), Some(Duration::from_millis(50)));
        assert_eq!(POLICY.pause(1, 0.5), Some(Duration::from_millis(75)));
        assert!((0..1000).all(|_| (0.0..=1.0).contains(&chance())));
    }

    #[test]
    fn a_pause_is_as_long_as_the_server_asks_for_and_not_endless() {
        for (requested, least) in [(0, 0), (20, 20), (1_000_000, 60_000)] {
            let error = busy(requested);
            assert!(error.is_transient());
            let pause = requested_pause(Some(&error)).as_millis();
            assert!((least..=2 * least).contains(&pause), "{requested}: {pause}");
        }
        assert_eq!(requested_pause(None), Duration::ZERO);
    }

    /// The clock is paused: it jumps ahead whenever all tasks wait.
    #[tokio::test(start_paused = true)]
    async fn a_try_without_time_left_does_not_hide_why_the_one_before_failed() {
        let timeout = Duration::from_millis(150);
        let deadline = Instant::now() + timeout;
        let mut tries = 0;
        let attempt = || {
            tries += 1;
            let refused = Refusal::from_status(&tonic::Status::unavailable("starting"));
            std::future::ready(Err::<(), _>(match tries {
                1 => Error::Refused(Box::new(refused)),
                _ => Error::timeout("knn", timeout),
            }))
        };
        let error = POLICY.run(deadline, attempt).await.unwrap_err();
        assert_eq!((tries, error.code()), (2, tonic::Code::DeadlineExceeded));
        let message = error.to_string();
        assert!(
            message.starts_with("knn: no answer within 150ms; a try before: starting"),
            "{message}"
        );
    }

    #[test]
    fn endless_tries_do_not_overflow() {
        let policy = RetryPolicy::until_deadline();
        assert_eq!(policy.pause(u32::MAX - 1, 1.0), Some(policy.longest));
        assert_eq!(RetryPolicy::never().pause(1, 1.0), None);
    }
}
