//! A server to which Foxglove and its kin connect, by the protocol
//! [foxglove.sdk.v1](https://github.com/foxglove/ws-protocol) over a WebSocket.
//!
//! Each viewer has a queue of its own, of which the oldest messages are dropped: a slow one slows nobody.

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use anyhow::{Context as _, Result, bail};
use foxglove::websocket::{ChannelView, Client, ServerListener};
use foxglove::{Context, PartialMetadata, RawChannel, WebSocketServer};

use super::sinks::{Message, MessageSink, Topic};

/// Messages that wait for a slow viewer: those of about ten frames.
const MOST_WAITING: usize = 64;

/// Topics whose last message is sent to viewers that connect later.
const LATCHED: [&str; 2] = ["/map", "/state"];

/// The server. Viewers are served until the process ends.
pub struct Viewer {
    /// Channels and viewers end with it.
    _context: Arc<Context>,
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
    /// Serves topics at an address; with port 0, at any free port.
    pub fn listen(address: SocketAddr, topics: &[Topic]) -> Result<Self> {
        let (context, latched) = (Context::new(), Arc::<Latched>::default());
        // All channels exist before the first viewer connects: the server announces a later one to viewers before it accepts
        // their subscriptions to it.
        let channels = topics.iter().map(|topic| {
            let builder = (context.channel_builder(topic.name))
                .message_encoding(&topic.encoding)
                .schema(topic.schema.clone());
            anyhow::Ok((topic.name, builder.build_raw()?))
        });
        let channels = channels.collect::<Result<_>>()?;
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
            _context: context,
            channels,
            latched,
        })
    }
}

impl MessageSink for Viewer {
    fn write(&mut self, message: &Message) -> Result<()> {
        let topic = message.topic.name;
        let Some(channel) = self.channels.get(topic) else {
            bail!("{topic} is not served");
        };
        if LATCHED.contains(&topic) {
            let latched = LatchedMessage {
                channel: channel.clone(),
                stamp: message.stamp,
                data: message.data.to_vec(),
            };
            self.latched.messages().insert(topic, latched);
        }
        channel.log_with_meta(message.data, PartialMetadata::with_log_time(message.stamp));
        Ok(())
    }

    /// What waits is still sent while the results are written.
    fn finish(&mut self) -> Result<()> {
        Ok(())
    }
}
