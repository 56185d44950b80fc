//! Calls in bare HTTP/2: tonic's client hides refusals of streams and the ends of connections, and is too slow to
//! overload a server from one core.

use std::{net::SocketAddr, time::Duration};

use bytes::{BufMut, Bytes, BytesMut};
use h2::client::{Builder, Connection, ResponseFuture, SendRequest};
use http::{HeaderMap, HeaderValue, Request, header};
use prost::Message;
use tokio::net::TcpStream;
use tonic::Code;

pub(crate) const KNN: &str = "wayfold.v1.PointService/Knn";
pub(crate) const STREAM_KNN: &str = "wayfold.v1.PointService/StreamKnn";
pub(crate) const INSERT: &str = "wayfold.v1.PointService/Insert";
pub(crate) const HEALTH: &str = "grpc.health.v1.Health/Check";

/// The flow-control windows of a client that reads its answers, in bytes.
pub(crate) const LARGE_WINDOW: u32 = 4 * 1024 * 1024;
/// The windows of HTTP/2 without a setting, for a client that reads nothing or sends only.
pub(crate) const DEFAULT_WINDOW: u32 = 65_535;

pub(crate) type Client = SendRequest<Bytes>;

/// The end of a call.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Outcome {
    /// The server answered with this status.
    Status(Code),
    /// The client gave the call up at its deadline.
    Expired,
    /// The server reset the stream, for this reason.
    Reset(u32),
    /// The connection ended.
    Lost,
}

impl From<h2::Error> for Outcome {
    fn from(error: h2::Error) -> Self {
        match error.reason() {
            Some(reason) if error.is_reset() => Self::Reset(reason.into()),
            _ => Self::Lost,
        }
    }
}

/// Opens a connection; its second part must be polled.
pub(crate) async fn open(
    address: SocketAddr,
    window: u32,
) -> Result<(Client, Connection<TcpStream>), Outcome> {
    let socket = TcpStream::connect(address).await;
    let socket = socket.map_err(|_| Outcome::Lost)?;
    let _ = socket.set_nodelay(true);
    Ok(Builder::new()
        .initial_window_size(window)
        .initial_connection_window_size(window)
        // By default this library itself ends a connection once many answers come to calls that were given up.
        .max_concurrent_reset_streams(100_000)
        .max_local_error_reset_streams(None)
        .handshake(socket)
        .await?)
}

/// Opens a connection and polls it in the background.
pub(crate) async fn connect(address: SocketAddr, window: u32) -> Result<Client, Outcome> {
    let (client, connection) = open(address, window).await?;
    tokio::spawn(connection);
    Ok(client)
}

/// The headers of a call.
pub(crate) fn headers(address: SocketAddr, path: &str) -> Request<()> {
    Request::post(format!("http://{address}/{path}"))
        .header(header::CONTENT_TYPE, "application/grpc")
        .header(header::TE, "trailers")
        .body(())
        .expect("a request")
}

/// The deadline as a header's value.
pub(crate) fn timeout_header(timeout: Duration) -> HeaderValue {
    let text = format!("{}m", timeout.as_millis());
    HeaderValue::from_str(&text).expect("digits")
}

/// A message as it is sent.
pub(crate) fn frame(message: &impl Message) -> Bytes {
    let mut frame = BytesMut::new();
    frame.put_u8(0);
    frame.put_u32(message.encoded_len() as u32);
    message.encode(&mut frame).expect("room that grows");
    frame.freeze()
}

/// Makes a call with one message.
pub(crate) async fn call(client: &Client, headers: Request<()>, message: Bytes) -> Outcome {
    match begin(client, headers, message) {
        Ok(response) => outcome(response).await,
        Err(error) => error.into(),
    }
}

/// Sends a call with one message.
pub(crate) fn begin(
    client: &Client,
    headers: Request<()>,
    message: Bytes,
) -> Result<ResponseFuture, h2::Error> {
    // A handle refuses further calls once a call of its own waits for a stream; a clone does not.
    let (response, mut body) = client.clone().send_request(headers, false)?;
    body.send_data(message, true)?;
    Ok(response)
}

/// Reads an answer to its status.
pub(crate) async fn outcome(response: ResponseFuture) -> Outcome {
    read(response).await.unwrap_or_else(Outcome::from)
}

async fn read(response: ResponseFuture) -> Result<Outcome, h2::Error> {
    let response = response.await?;
    if let Some(status) = status(response.headers()) {
        return Ok(status);
    }
    let mut body = response.into_body();
    while let Some(bytes) = body.data().await {
        let length = bytes?.len();
        body.flow_control().release_capacity(length)?;
    }
    let trailers = body.trailers().await?.unwrap_or_default();
    Ok(status(&trailers).unwrap_or(Outcome::Status(Code::Unknown)))
}

fn status(headers: &HeaderMap) -> Option<Outcome> {
    let status = headers.get("grpc-status")?;
    Some(Outcome::Status(Code::from_bytes(status.as_bytes())))
}
