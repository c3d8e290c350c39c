//! Where messages of topics go: files, and viewers that are connected.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{BufWriter, Seek, Write};
use std::path::{Path, PathBuf};

use anyhow::{Context as _, Result};
use foxglove::{Encode, Schema};
use mcap::records::{MessageHeader, Metadata};
use mcap::{WriteOptions, Writer};
use serde_json::Value;

use crate::files::GrowingFile;
use crate::georeference::Georeference;

/// A topic, and how its messages are encoded.
pub struct Topic {
    pub name: &'static str,
    pub schema: Schema,
    pub encoding: String,
}

impl Topic {
    /// That of messages of Foxglove.
    pub fn of<M: Encode>(name: &'static str) -> Result<Self> {
        Ok(Self {
            name,
            schema: M::get_schema().context("the message has no schema")?,
            encoding: M::get_message_encoding(),
        })
    }

    /// That of numbers of a frame as JSON.
    pub fn of_numbers(name: &'static str) -> Self {
        const SCHEMA: &str = include_str!("frame.schema.json");
        Self {
            name,
            schema: Schema::new("fpmcl.Frame", "jsonschema", SCHEMA.as_bytes()),
            encoding: "json".to_owned(),
        }
    }
}

/// An encoded message.
pub struct Message<'a> {
    /// Its topic.
    pub topic: &'a Topic,
    /// Its time [ns].
    pub stamp: u64,
    /// Its bytes.
    pub data: &'a [u8],
}

/// Takes messages.
pub trait MessageSink {
    /// Takes a message.
    fn write(&mut self, message: &Message) -> Result<()>;

    /// Writes what waits to the file, so that it is kept if the process is killed.
    fn flush(&mut self) -> Result<()> {
        Ok(())
    }

    /// Completes what was written.
    fn finish(&mut self) -> Result<()>;
}

impl dyn MessageSink + '_ {
    /// Encodes a message of Foxglove.
    pub fn send<M: Encode>(&mut self, topic: &'static str, stamp: u64, message: &M) -> Result<()>
    where
        M::Error: Send + Sync + 'static,
    {
        let mut data = Vec::with_capacity(message.encoded_len().unwrap_or(0));
        message.encode(&mut data)?;
        self.write(&Message {
            topic: &Topic::of::<M>(topic)?,
            stamp,
            data: &data,
        })
    }

    /// Encodes numbers of a frame as JSON.
    pub fn send_json(&mut self, topic: &'static str, stamp: u64, message: &Value) -> Result<()> {
        self.write(&Message {
            topic: &Topic::of_numbers(topic),
            stamp,
            data: &serde_json::to_vec(message)?,
        })
    }
}

/// A log in the format MCAP. Channels by topic, made when they are first used.
pub struct McapSink<W: Write + Seek> {
    writer: Writer<W>,
    channels: BTreeMap<&'static str, u16>,
    sequence: u32,
}

impl<W: Write + Seek> McapSink<W> {
    /// An empty log.
    pub fn new(writer: W) -> Result<Self> {
        let options = WriteOptions::new()
            .compression(None)
            // One entry per chunk stays in memory, for the index at the end: 1 MB per hour.
            .chunk_size(Some(1 << 22))
            // A chunk is written once it is complete, with its length: readers of a log that ends early rely on that.
            .disable_seeking(true)
            .library(concat!("fpmcl ", env!("CARGO_PKG_VERSION")));
        Ok(Self {
            writer: options.create(writer)?,
            channels: BTreeMap::new(),
            sequence: 0,
        })
    }

    /// Writes the place of the map on the Earth, as JSON in the metadata `map`.
    pub fn write_georeference(&mut self, georeference: &Georeference) -> Result<()> {
        let text = serde_json::to_string(georeference)?;
        Ok(self.writer.write_metadata(&Metadata {
            name: "map".to_owned(),
            metadata: BTreeMap::from([("georeference".to_owned(), text)]),
        })?)
    }
}

impl<W: Write + Seek> MessageSink for McapSink<W> {
    fn write(&mut self, message: &Message) -> Result<()> {
        let Message { topic, stamp, data } = *message;
        let channel_id = match self.channels.get(topic.name) {
            Some(&channel) => channel,
            None => {
                let (writer, schema) = (&mut self.writer, &topic.schema);
                let schema = writer.add_schema(&schema.name, &schema.encoding, &schema.data)?;
                let (name, none) = (topic.name, BTreeMap::new());
                let channel = writer.add_channel(schema, name, &topic.encoding, &none)?;
                self.channels.insert(name, channel);
                channel
            }
        };
        let header = MessageHeader {
            channel_id,
            sequence: self.sequence,
            log_time: stamp,
            publish_time: stamp,
        };
        self.sequence += 1;
        Ok(self.writer.write_to_known_channel(&header, data)?)
    }

    fn flush(&mut self) -> Result<()> {
        Ok(self.writer.flush()?)
    }

    fn finish(&mut self) -> Result<()> {
        self.writer.finish().context("cannot finish the log")?;
        Ok(())
    }
}

/// A log that replaces a file once it is complete. Until then it is next to it, in [`unfinished_log`], where it stays if the process is
/// killed or the disk is full: whole chunks, without an index.
pub struct McapFile {
    log: McapSink<BufWriter<File>>,
    file: Option<GrowingFile>,
}

/// The file in which a log grows: `run.unfinished.mcap` for `run.mcap`.
pub fn unfinished_log(path: &Path) -> PathBuf {
    path.with_extension("unfinished.mcap")
}

impl McapFile {
    /// Begins a file.
    pub fn create(path: &Path) -> Result<Self> {
        let create = || {
            let file = GrowingFile::create(path, &unfinished_log(path))?;
            let log = McapSink::new(BufWriter::new(file.file().try_clone()?))?;
            let file = Some(file);
            anyhow::Ok(Self { log, file })
        };
        create().with_context(|| format!("cannot write {}", path.display()))
    }
}

impl MessageSink for McapFile {
    fn write(&mut self, message: &Message) -> Result<()> {
        self.log.write(message)
    }

    fn flush(&mut self) -> Result<()> {
        self.log.flush()
    }

    fn finish(&mut self) -> Result<()> {
        self.log.finish()?;
        match self.file.take() {
            Some(file) => Ok(file.persist()?),
            None => Ok(()),
        }
    }
}

impl Drop for McapFile {
    /// A log without a message is nothing that is worth keeping.
    fn drop(&mut self) {
        if let Some(file) = self.file.take()
            && self.log.sequence == 0
        {
            let _ = file.remove();
        }
    }
}

/// Several sinks; one that fails is warned of and left out, because a drive does not end for it.
#[derive(Default)]
pub struct Sinks(Vec<(String, Box<dyn MessageSink + Send>)>);

impl Sinks {
    /// Adds a sink with its name in warnings.
    pub fn add(&mut self, name: String, sink: impl MessageSink + Send + 'static) {
        self.0.push((name, Box::new(sink)));
    }

    /// Whether nothing takes a message.
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// Those in which an action succeeds.
    fn retain(&mut self, mut action: impl FnMut(&mut dyn MessageSink) -> Result<()>) {
        self.0.retain_mut(|(name, sink)| {
            let outcome = action(&mut **sink);
            if let Err(error) = &outcome {
                tracing::warn!("{name} ends: {error:#}");
            }
            outcome.is_ok()
        });
    }
}

impl MessageSink for Sinks {
    fn write(&mut self, message: &Message) -> Result<()> {
        self.retain(|sink| sink.write(message));
        Ok(())
    }

    fn flush(&mut self) -> Result<()> {
        self.retain(|sink| sink.flush());
        Ok(())
    }

    fn finish(&mut self) -> Result<()> {
        self.retain(|sink| sink.finish());
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;
    use std::sync::atomic::{AtomicUsize, Ordering};

    use anyhow::bail;
    use serde_json::json;

    use super::*;

    /// Counts messages, of which it takes a number.
    struct Counting(Arc<AtomicUsize>, usize);

    impl MessageSink for Counting {
        fn write(&mut self, _message: &Message) -> Result<()> {
            if self.0.fetch_add(1, Ordering::Relaxed) == self.1 {
                bail!("no space left");
            }
            Ok(())
        }

        fn finish(&mut self) -> Result<()> {
            self.write(&Message {
                topic: &Topic::of_numbers("/numbers"),
                stamp: 0,
                data: &[],
            })
        }
    }

    #[test]
    fn a_sink_that_fails_is_left_out_and_the_others_get_all() {
        let counts = [Arc::<AtomicUsize>::default(), Arc::default()];
        let mut sinks = Sinks::default();
        for (count, most) in counts.iter().zip([2, usize::MAX]) {
            sinks.add("a log".to_owned(), Counting(count.clone(), most));
        }
        let all: &mut dyn MessageSink = &mut sinks;
        for stamp in 0..5 {
            all.send_json("/numbers", stamp, &json!({})).unwrap();
        }
        all.finish().unwrap();
        assert_eq!(counts.map(|it| it.load(Ordering::Relaxed)), [3, 6]);
        assert!(!sinks.is_empty());
    }
}
