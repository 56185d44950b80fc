//! A client that speaks bare HTTP/2: tonic's hides the server's deadlines, and the ends of connections.

use std::net::SocketAddr;

use bytes::{BufMut, Bytes, BytesMut};
use h2::{
    SendStream,
    client::{ResponseFuture, SendRequest},
};
use http::{Request, header, request::Builder};
use prost::Message;
use tokio::net::TcpStream;
use tonic::{Code, Status};
use wayfold_proto::v1;

/// A connection of HTTP/2.
pub struct Connection {
    address: SocketAddr,
    client: SendRequest<Bytes>,
}

impl Connection {
    pub async fn open(address: SocketAddr) -> Self {
        Self::build(address, &h2::client::Builder::new()).await
    }

    /// The connection of a client that makes no room for any byte of an answer.
    pub async fn open_without_window(address: SocketAddr) -> Self {
        Self::build(address, h2::client::Builder::new().initial_window_size(0)).await
    }

    async fn build(address: SocketAddr, builder: &h2::client::Builder) -> Self {
        let socket = TcpStream::connect(address).await.unwrap();
        let (client, connection) = builder.handshake(socket).await.unwrap();
        tokio::spawn(connection);
        Self { address, client }
    }

    /// The headers of a call.
    pub fn request(&self, rpc: &str) -> Builder {
        self.request_of(&format!("wayfold.v1.{rpc}"))
    }

    /// The same for a method of any service.
    pub fn request_of(&self, method: &str) -> Builder {
        Request::post(format!("http://{}/{method}", self.address))
            .header(header::CONTENT_TYPE, "application/grpc")
            .header(header::TE, "trailers")
    }

    /// Begins a call; its messages go into the stream.
    pub async fn begin(
        &mut self,
        request: Builder,
    ) -> Result<(ResponseFuture, SendStream<Bytes>), h2::Error> {
        let client = self.client.clone();
        let mut client = client.ready().await?;
        client.send_request(request.body(()).unwrap(), false)
    }

    /// Makes a small call.
    pub async fn call(&mut self) -> Result<Status, h2::Error> {
        let request = self.request("IndexService/GetServer");
        let (answer, mut body) = self.begin(request).await?;
        body.send_data(frame(&v1::GetServerRequest {}), true)?;
        status(answer).await
    }

    pub async fn expect_call(&mut self) {
        assert_eq!(self.call().await.unwrap().code(), Code::Ok);
    }
}

/// A message as it is sent.
pub fn frame(message: &impl Message) -> Bytes {
    let mut frame = BytesMut::new();
    frame.put_u8(0);
    frame.put_u32(message.encoded_len() as u32);
    message.encode(&mut frame).unwrap();
    frame.freeze()
}

/// The status of an answer, from its trailers or, where there is no message, from its headers.
pub async fn status(answer: ResponseFuture) -> Result<Status, h2::Error> {
    let answer = answer.await?;
    if let Some(status) = Status::from_header_map(answer.headers()) {
        return Ok(status);
    }
    let mut body = answer.into_body();
    while let Some(bytes) = body.data().await {
        let length = bytes?.len();
        body.flow_control().release_capacity(length)?;
    }
    let trailers = body.trailers().await?.unwrap();
    Ok(Status::from_header_map(&trailers).unwrap())
}
