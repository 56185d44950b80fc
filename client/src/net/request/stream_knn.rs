//! Nearest neighbours, pipelined.

use std::time::Duration;

use futures_util::{Stream, stream};
use tokio::{sync::mpsc, time::Instant};
use tokio_stream::wrappers::ReceiverStream;
use tonic::Streaming;
use wayfold_proto::v1::{self, stream_knn_response::Result as Answer};

use super::knn;
use crate::{
    Error, Include, IndexHandle, Knn, Neighbors, Refusal, States, net::connections::Connection,
};

/// The sending half of a stream of [`Knn`] requests, which are answered in their order.
///
/// Dropping it ends the stream once all requests are answered. Requests wait while the caller takes no answers: send
/// and take in two tasks, or keep a bounded number under way.
///
/// ```no_run
/// # async fn example(index: wayfold::IndexHandle, states: Vec<[f64; 7]>) -> Result<(), wayfold::Error> {
/// let (mut requests, mut answers) = index.stream_knn().await?;
/// for (i, state) in states.iter().enumerate() {
///     requests.send(index.knn([state]).k(10)).await?;
///     if i >= 64 {
///         let neighbors = answers.next().await?;
///         // Use them.
///     }
/// }
/// drop(requests);
/// while let Some(neighbors) = answers.next().await? {
///     // Use them.
/// }
/// # Ok(())
/// # }
/// ```
#[derive(Debug)]
pub struct KnnRequests {
    uri: String,
    messages: mpsc::Sender<v1::StreamKnnRequest>,
    /// The requests under way, to check their answers by.
    pending: mpsc::UnboundedSender<Pending>,
}

/// The receiving half of a stream of [`Knn`] requests: one answer each, in their order. A failed request is answered
/// with its error, and the stream continues; an error of the stream itself ends it. There is no timeout: bound the wait
/// with `tokio::time::timeout` if necessary.
#[derive(Debug)]
pub struct KnnAnswers {
    uri: String,
    timeout: Duration,
    messages: Streaming<v1::StreamKnnResponse>,
    pending: mpsc::UnboundedReceiver<Pending>,
    over: bool,
}

/// A request under way.
#[derive(Debug)]
struct Pending {
    index: IndexHandle,
    rows: usize,
    include: Include,
}

const CALL: &str = "stream_knn";

/// The number of requests that may wait in the client for the connection.
const MAX_WAITING: usize = 64;

pub(crate) async fn open_stream(index: &IndexHandle) -> Result<(KnnRequests, KnnAnswers), Error> {
    let (client, timeout) = (index.client(), index.timeout());
    let mut sender = None;
    let attempt = |connection: Connection, _remaining: Duration| {
        let (messages, receiver) = mpsc::channel(MAX_WAITING);
        sender = Some(messages);
        let mut stub = connection.points();
        // Without a deadline, which would bound the whole stream.
        async move { stub.stream_knn(ReceiverStream::new(receiver)).await }
    };
    let deadline = Instant::now() + timeout;
    let (answers, connection) = client.call_at(CALL, timeout, deadline, attempt).await?;
    let uri = connection.uri();
    let messages = sender.ok_or_else(|| over(uri))?;
    let (sent, pending) = mpsc::unbounded_channel();
    let requests = KnnRequests {
        uri: uri.to_string(),
        messages,
        pending: sent,
    };
    let answers = KnnAnswers {
        uri: uri.to_string(),
        timeout,
        messages: answers,
        pending,
        over: false,
    };
    Ok((requests, answers))
}

impl KnnRequests {
    /// Sends a request. It is not divided: the answer to one that exceeds a limit of the server is
    /// `RESOURCE_EXHAUSTED`.
    ///
    /// # Errors
    /// [`Error::Width`] and [`Error::Layout`], with which nothing is sent, and [`Error::Connection`] if the stream is
    /// over: the answers end with the cause.
    pub async fn send(&mut self, mut request: Knn) -> Result<(), Error> {
        let states = std::mem::replace(&mut request.states, Ok(States::new(0)))?;
        let knn = Some(request.message(&states, 0..states.len()));
        // Both are sent, or neither if this future is dropped while it waits.
        let message = self.messages.reserve().await.map_err(|_| over(&self.uri))?;
        let pending = Pending {
            rows: states.len(),
            include: request.options.include,
            index: request.index,
        };
        self.pending.send(pending).map_err(|_| over(&self.uri))?;
        message.send(v1::StreamKnnRequest { knn });
        Ok(())
    }
}

fn over(uri: &str) -> Error {
    Error::Connection {
        call: CALL,
        uri: uri.to_owned(),
        source: "the stream is over".into(),
    }
}

impl KnnAnswers {
    /// The answer to the next request; `None` once all are answered and the sending half is dropped.
    ///
    /// # Errors
    /// The error of the request, after which the stream continues, or the error of the stream, which ends it.
    pub async fn next(&mut self) -> Result<Option<Neighbors>, Error> {
        if self.over {
            return Ok(None);
        }
        match self.messages.message().await {
            Ok(Some(response)) => self.answer(response).map(Some),
            Ok(None) => {
                self.over = true;
                Ok(None)
            }
            Err(status) => {
                self.over = true;
                Err(Error::from_status(CALL, &self.uri, self.timeout, status))
            }
        }
    }

    /// The rest as a [`Stream`].
    pub fn into_stream(self) -> impl Stream<Item = Result<Neighbors, Error>> + Send + 'static {
        stream::unfold(self, |mut answers| async move {
            let answer = answers.next().await.transpose()?;
            Some((answer, answers))
        })
    }

    fn answer(&mut self, response: v1::StreamKnnResponse) -> Result<Neighbors, Error> {
        let wrong = |problem: &str| Error::protocol(CALL, problem);
        let pending = self.pending.try_recv();
        let request = pending.map_err(|_| wrong("an answer to no request"))?;
        match response.result {
            Some(Answer::Knn(answer)) => {
                let found = (answer.neighbors, answer.revision);
                knn::neighbors(CALL, &request.index, found, request.rows, request.include)
            }
            Some(Answer::Error(status)) => {
                Err(Error::Refused(Box::new(Refusal::from_message(&status))))
            }
            None => Err(wrong("neither an answer nor an error")),
        }
    }
}
