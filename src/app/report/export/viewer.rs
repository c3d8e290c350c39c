//! A server to which Foxglove and its kin connect, by the protocol
//! [foxglove.sdk.v1](https://github.com/foxglove/ws-protocol) over a WebSocket.
//!
//! Each viewer has a queue of its own, of which the oldest messages are dropped: a slow one slows nobody.

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use anyhow::{Context as _, Result};
use foxglove::websocket::{ChannelView, Client, ServerListener};
use foxglove::{Context, PartialMetadata, RawChannel, WebSocketServer};

use super::sinks::{Message, MessageSink};

/// Messages that wait for a slow viewer: those of about ten frames.
const MOST_WAITING: usize = 64;

/// Topics whose last message is sent to viewers that connect later.
const LATCHED: [&str; 2] = ["/map", "/state"];

/// The server. Viewers are served until the process ends.
pub struct Viewer {
    context: Arc<Context>,
    channels: BTreeMap<&'static str, Arc<RawChannel>>,
    latched: Arc<Latched>,
    /// The address at which it listens.
    pub address: SocketAddr,
}

/// The messages that later viewers get, by their topic.
#[derive(Default)]
struct Latched(Mutex<BTreeMap<&'static str, LatchedMessage>>);

struct LatchedMessage {
    channel: Arc<RawChannel>,
    stamp: u64,
    data: Vec<u8>,
}

impl Latched {
    fn messages(&self) -> MutexGuard<'_, BTreeMap<&'static str, LatchedMessage>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl ServerListener for Latched {
    fn on_subscribe(&self, client: Client, channel: ChannelView) {
        if let Some(latched) = self.messages().get(channel.topic()) {
            let meta = PartialMetadata::with_log_time(latched.stamp);
            let viewer = client.sink_id();
            let channel = &latched.channel;
            channel.log_with_meta_to_sink(&latched.data, meta, viewer);
        }
    }
}

impl Viewer {
    /// Listens at an address; with port 0, at any free port.
    pub fn listen(address: SocketAddr) -> Result<Self> {
        let (context, latched) = (Context::new(), Arc::<Latched>::default());
        let host = match address {
            SocketAddr::V4(address) => address.ip().to_string(),
            SocketAddr::V6(address) => format!("[{}]", address.ip()),
        };
        let server = WebSocketServer::new()
            .name("fpmcl")
            .bind(host, address.port())
            .context(&context)
            .message_backlog_size(MOST_WAITING)
            .listener(latched.clone())
            .start_blocking()
            .with_context(|| {
                format!("cannot listen at {address}; give --foxglove another address or port")
            })?;
        Ok(Self {
            address: SocketAddr::new(address.ip(), server.port()),
            context,
            channels: BTreeMap::new(),
            latched,
        })
    }

    /// The channel of a message, made when it is first used.
    fn channel(&mut self, message: &Message) -> Result<Arc<RawChannel>> {
        if let Some(channel) = self.channels.get(message.topic) {
            return Ok(channel.clone());
        }
        let builder = self.context.channel_builder(message.topic);
        let builder = builder.message_encoding(message.encoding);
        let channel = builder.schema(message.schema.clone()).build_raw()?;
        self.channels.insert(message.topic, channel.clone());
        Ok(channel)
    }
}

impl MessageSink for Viewer {
    fn write(&mut self, message: &Message) -> Result<()> {
        let channel = self.channel(message)?;
        if LATCHED.contains(&message.topic) {
            let latched = LatchedMessage {
                channel: channel.clone(),
                stamp: message.stamp,
                data: message.data.to_vec(),
            };
            self.latched.messages().insert(message.topic, latched);
        }
        channel.log_with_meta(message.data, PartialMetadata::with_log_time(message.stamp));
        Ok(())
    }

    /// What waits is still sent while the results are written.
    fn finish(&mut self) -> Result<()> {
        Ok(())
    }
}
