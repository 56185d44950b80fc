//! Nearest neighbours, pipelined.

use std::{
    pin::Pin,
    task::{Context, Poll, ready},
    time::Duration,
};

use futures_util::{Stream, StreamExt};
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tonic::Streaming;
use wayfold_proto::v1::{self, stream_knn_response::Result as Answer};

use super::knn;
use crate::{Error, Include, IndexHandle, Knn, Neighbors, Refusal, States};

/// The sending half of a stream of [`Knn`] requests, which are answered in their order.
///
/// Dropping it ends the stream, once what was sent is answered. Requests wait where answers are not taken: send and
/// take in two tasks, or keep a bounded number under way.
///
/// ```no_run
/// # async fn example(index: wayfold::IndexHandle, states: Vec<[f64; 7]>) -> Result<(), wayfold::Error> {
/// let (mut requests, mut answers) = index.stream_knn().await?;
/// for (i, state) in states.iter().enumerate() {
///     requests.send(index.knn([state]).k(10)).await?;
///     if i >= 64 {
///         let answer = answers.next().await;
///         // Use it.
///     }
/// }
/// drop(requests);
/// while let Some(answer) = answers.next().await {
///     let neighbors = answer?;
/// }
/// # Ok(())
/// # }
/// ```
#[derive(Debug)]
pub struct KnnRequests {
    uri: String,
    messages: mpsc::Sender<v1::StreamKnnRequest>,
    /// What the requests under way asked for, to read their answers by.
    asked: mpsc::UnboundedSender<Asked>,
}

/// The receiving half of a stream of [`Knn`] requests: one answer each, in their order. A request that fails has its
/// error, and the stream goes on; after an error of the stream itself it ends. There is no timeout: bound the wait
/// with `tokio::time::timeout` where that is needed.
#[derive(Debug)]
pub struct KnnAnswers {
    uri: String,
    timeout: Duration,
    messages: Streaming<v1::StreamKnnResponse>,
    asked: mpsc::UnboundedReceiver<Asked>,
    over: bool,
}

#[derive(Debug)]
struct Asked {
    index: IndexHandle,
    rows: usize,
    include: Include,
}

const CALL: &str = "stream_knn";

/// How many requests wait in the client for the connection to take them.
const WAITING: usize = 64;

pub(crate) async fn open_stream(index: &IndexHandle) -> Result<(KnnRequests, KnnAnswers), Error> {
    let (client, timeout) = (index.client(), index.timeout());
    let (stub, mut sender) = (client.points(), None);
    let attempt = |_remaining: Duration| {
        let (messages, receiver) = mpsc::channel(WAITING);
        sender = Some(messages);
        let mut stub = stub.clone();
        // Without a deadline, which would bound the whole stream.
        async move { stub.stream_knn(ReceiverStream::new(receiver)).await }
    };
    let answers = client.call(CALL, timeout, attempt).await?;
    let messages = sender.ok_or_else(|| over(client.uri()))?;
    let (asked, asked_of) = mpsc::unbounded_channel();
    let requests = KnnRequests {
        uri: client.uri().to_owned(),
        messages,
        asked,
    };
    let answers = KnnAnswers {
        uri: client.uri().to_owned(),
        timeout,
        messages: answers,
        asked: asked_of,
        over: false,
    };
    Ok((requests, answers))
}

impl KnnRequests {
    /// Sends a request. It is not divided: what exceeds a limit of the server is answered with `RESOURCE_EXHAUSTED`.
    ///
    /// # Errors
    /// [`Error::Width`] and [`Error::Layout`], with which nothing is sent, and [`Error::Connection`] if the stream is
    /// over: the answers tell why.
    pub async fn send(&mut self, mut request: Knn) -> Result<(), Error> {
        let states = std::mem::replace(&mut request.states, Ok(States::new(0)))?;
        let knn = Some(request.message(&states, 0..states.len()));
        // Both are sent, or, where this future is dropped while it waits, neither.
        let message = self.messages.reserve().await.map_err(|_| over(&self.uri))?;
        let asked = Asked {
            rows: states.len(),
            include: request.options.include,
            index: request.index,
        };
        self.asked.send(asked).map_err(|_| over(&self.uri))?;
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
    /// The answer to the next request; `None` when all are answered and the sending half is dropped.
    pub async fn next(&mut self) -> Option<Result<Neighbors, Error>> {
        StreamExt::next(self).await
    }

    fn answer(&mut self, response: v1::StreamKnnResponse) -> Result<Neighbors, Error> {
        let wrong = |problem: &str| Error::Protocol {
            call: CALL,
            problem: problem.to_owned(),
        };
        let asked = self
            .asked
            .try_recv()
            .map_err(|_| wrong("an answer to no request"))?;
        match response.result {
            Some(Answer::Knn(answer)) => {
                asked.index.told(&answer.uid, answer.revision);
                knn::answered(
                    CALL,
                    answer,
                    asked.rows,
                    asked.include,
                    asked.index.coordinates(),
                )
            }
            Some(Answer::Error(status)) => {
                Err(Error::Refused(Box::new(Refusal::from_message(&status))))
            }
            None => Err(wrong("neither an answer nor an error")),
        }
    }
}

impl Stream for KnnAnswers {
    type Item = Result<Neighbors, Error>;

    fn poll_next(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<Option<Self::Item>> {
        if self.over {
            return Poll::Ready(None);
        }
        let item = match ready!(self.messages.poll_next_unpin(cx)) {
            Some(Ok(response)) => Some(self.answer(response)),
            Some(Err(status)) => {
                self.over = true;
                Some(Err(Error::from_status(
                    CALL,
                    &self.uri,
                    self.timeout,
                    status,
                )))
            }
            None => {
                self.over = true;
                None
            }
        };
        Poll::Ready(item)
    }
}
