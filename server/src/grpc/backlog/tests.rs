//! A connection counts all bytes that unread frames may hold, and few bytes for a stream that reads.

use std::collections::VecDeque;

use proptest::prelude::*;

use super::*;

/// The frames that HTTP/2 keeps for a stream.
#[derive(Default)]
struct Queue {
    /// Each frame, and the position after it.
    frames: VecDeque<(Bytes, u64)>,
    reader: Option<Waker>,
}

impl Body for Queue {
    type Data = Bytes;
    type Error = ();

    fn poll_frame(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
    ) -> Poll<Option<Result<Frame<Bytes>, ()>>> {
        let Some((frame, _)) = self.frames.pop_front() else {
            self.reader = Some(context.waker().clone());
            return Poll::Pending;
        };
        Poll::Ready(Some(Ok(Frame::data(frame))))
    }
}

impl Queue {
    fn bytes(&self) -> usize {
        self.frames.iter().map(|(frame, _)| frame.len()).sum()
    }
}

/// A stream, its connection, and what was sent and read of the stream.
struct Run {
    connection: Arc<ConnectionBacklog>,
    stream: StreamBacklog<()>,
    queue: Queue,
    sent: Vec<u8>,
    read: Vec<u8>,
}

impl Run {
    fn new(budget: usize) -> Self {
        let budget = Arc::new(ByteBudget::new(budget));
        let connection = Arc::new(ConnectionBacklog::new(budget));
        Self {
            stream: connection.open(),
            connection,
            queue: Queue::default(),
            sent: Vec::new(),
            read: Vec::new(),
        }
    }

    /// The connection reads something else. False if there is no room for what counts.
    fn other(&self, bytes: usize) -> bool {
        self.connection.note_read(bytes)
    }

    /// The connection reads a frame of the stream, if the window has room for it.
    fn frame(&mut self, bytes: usize) -> bool {
        if self.queue.bytes() + bytes > STREAM_WINDOW as usize {
            return true;
        }
        let has_room = self.connection.note_read(bytes);
        let position = self.connection.position.load(SeqCst);
        let frame = vec![self.sent.len() as u8; bytes];
        self.sent.extend_from_slice(&frame);
        self.queue.frames.push_back((frame.into(), position));
        self.queue.reader.take().into_iter().for_each(Waker::wake);
        has_room
    }

    /// Reads the stream once. False if nothing waits.
    fn read(&mut self) -> bool {
        let context = &mut Context::from_waker(Waker::noop());
        match self.stream.poll(context, &mut self.queue) {
            Poll::Ready(frame) => {
                let data = frame.unwrap().unwrap().into_data().unwrap();
                self.read.extend_from_slice(&data);
                true
            }
            Poll::Pending => false,
        }
    }
}

#[derive(Clone, Debug)]
enum Event {
    Frame(usize),
    Other(usize),
    Reads(usize),
}

fn bytes() -> impl Strategy<Value = usize> {
    prop_oneof![Just(1), 1..30_000_usize]
}

fn event() -> impl Strategy<Value = Event> {
    prop_oneof![
        bytes().prop_map(Event::Frame),
        bytes().prop_map(Event::Other),
        (1..20_usize).prop_map(Event::Reads),
    ]
}

proptest! {
    #![proptest_config(crate::testing::cases(200))]

    #[test]
    fn all_that_frames_hold_counts(events in prop::collection::vec(event(), 1..300)) {
        let mut run = Run::new(usize::MAX);
        for event in events {
            match event {
                Event::Frame(bytes) => prop_assert!(run.frame(bytes)),
                Event::Other(bytes) => prop_assert!(run.other(bytes)),
                Event::Reads(times) => for _ in 0..times {
                    if !run.read() {
                        prop_assert_eq!(run.connection.counted(), 0);
                        break;
                    }
                },
            }
            if let Some((_, oldest)) = run.queue.frames.front() {
                let held = run.connection.position.load(SeqCst) - oldest;
                prop_assert!(run.connection.counted() as u64 + STEP > held);
            }
        }
        while run.read() {}
        prop_assert!(run.read == run.sent);
        let Run { connection, stream, .. } = run;
        drop(stream);
        prop_assert_eq!(connection.counted(), 0);
    }

    /// Its client is always ahead: frames come while the stream is read, and HTTP/2 hardly says that none waits.
    #[test]
    fn a_stream_that_is_read_counts_little_whatever_else_its_connection_reads(
        rounds in prop::collection::vec(prop::collection::vec(1..30_000_usize, 2..6), 40..80),
    ) {
        let mut run = Run::new(FAR_BEHIND as usize + 2 * STREAM_WINDOW as usize);
        for frames in rounds {
            prop_assert!(run.other(100_000));
            for bytes in frames {
                prop_assert!(run.frame(bytes));
            }
            prop_assert!(run.read());
        }
    }
}

#[test]
fn a_stream_that_is_not_read_has_room_for_the_budget() {
    let mut run = Run::new(10 * STEP as usize);
    assert!(run.frame(1));
    assert!(run.other(9 * STEP as usize));
    assert!(!run.other(2 * STEP as usize));
    assert!(run.read() && !run.read());
    assert!(run.other(100 * STEP as usize));
}
