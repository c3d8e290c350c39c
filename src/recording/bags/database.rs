//! `.db3` of rosbag2: a database of SQLite with the tables `topics` and `messages`.
//!
//! A database is a program that its author wrote: a view can compute without end, and a value can have a gigabyte. So
//! only tables are read, whose rows ascend, in a bounded number of steps per row, and no value before its size is known.

use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};

use rusqlite::limits::Limit;
use rusqlite::types::ValueRef;
use rusqlite::{Error, OpenFlags};

use super::chunk_file::read_bytes;
use super::index::{Connection, Index, Place, Serialization};

/// Largest text, such as the name of a topic [bytes]. Messages are read by parts.
const LARGEST_TEXT: i32 = 1 << 20;

/// Largest number of topics, each of which is compared with all others.
const MOST_TOPICS: usize = 10_000;

/// Steps of SQLite's machine between two counts.
const COUNTED_STEPS: i32 = 1000;

/// Largest number of steps until the next row [`COUNTED_STEPS`]; a row of a table takes about ten steps.
const MOST_COUNTS: u32 = 1000;

/// A database that is read within limits.
pub struct Database {
    connection: rusqlite::Connection,
    /// Steps since the last row [`COUNTED_STEPS`].
    counts: Arc<AtomicU32>,
}

impl Database {
    /// Opens a database without writing next to it, but for the index of a log that an interrupted recorder left.
    pub fn open(path: &Path) -> Result<Self, String> {
        let mut log = path.as_os_str().to_owned();
        log.push("-wal");
        // A database whose recorder was interrupted has messages in its log, which needs a lock.
        let is_immutable = u8::from(!Path::new(&log).exists());
        let absolute = std::path::absolute(path).map_err(|error| error.to_string())?;
        let is_plain = |byte: u8| byte.is_ascii_alphanumeric() || b"/._-".contains(&byte);
        let bytes = absolute.as_os_str().as_encoded_bytes().iter();
        let escaped: String = bytes
            .map(|&byte| match byte {
                byte if is_plain(byte) => char::from(byte).to_string(),
                byte => format!("%{byte:02x}"),
            })
            .collect();
        let name = format!("file:{escaped}?immutable={is_immutable}");
        let flags = OpenFlags::SQLITE_OPEN_READ_ONLY
            | OpenFlags::SQLITE_OPEN_URI
            | OpenFlags::SQLITE_OPEN_NO_MUTEX;
        Self::limited(rusqlite::Connection::open_with_flags(name, flags)).map_err(damaged)
    }

    fn limited(connection: Result<rusqlite::Connection, Error>) -> Result<Self, Error> {
        let mut connection = connection?;
        connection.set_limit(Limit::SQLITE_LIMIT_LENGTH, LARGEST_TEXT)?;
        let counts = Arc::new(AtomicU32::new(0));
        let counted = counts.clone();
        let is_too_long = move || counted.fetch_add(1, Ordering::Relaxed) >= MOST_COUNTS;
        connection.progress_handler(COUNTED_STEPS, Some(is_too_long))?;
        Ok(Self { connection, counts })
    }

    /// Reads the index of a file into an empty one.
    pub fn index(&self, index: Index) -> Result<Index, String> {
        for table in ["topics", "messages"] {
            if !self.is_table(table).map_err(damaged)? {
                return Err(format!(
                    "is no bag of rosbag2: `{table}` is not a table with stored columns; record or convert it with `ros2 bag`"
                ));
            }
        }
        self.read_index(index).map_err(damaged)?
    }

    /// Whether a name is that of a table that has pages in the file, and no column that is computed.
    fn is_table(&self, name: &str) -> Result<bool, Error> {
        self.counts.store(0, Ordering::Relaxed);
        let has_pages = "SELECT count(*) FROM sqlite_master \
             WHERE name = ?1 COLLATE NOCASE AND type = 'table' AND rootpage > 0";
        let computed = "SELECT count(*) FROM pragma_table_xinfo(?1) WHERE hidden > 0";
        let count = |sql| {
            self.connection
                .query_row(sql, [name], |row| row.get::<_, i64>(0))
        };
        Ok(count(has_pages)? == 1 && count(computed)? == 0)
    }

    fn read_index(&self, mut index: Index) -> Result<Result<Index, String>, Error> {
        let topics = "SELECT rowid, id, name, type, serialization_format FROM topics NOT INDEXED";
        let mut topics = self.connection.prepare(topics)?;
        let mut rows = topics.query([])?;
        let mut last = None;
        while let Some(row) = rows.next()? {
            self.counts.store(0, Ordering::Relaxed);
            if !ascends(&mut last, row.get(0)?) {
                return Ok(Err(descending()));
            }
            let connection = Connection {
                topic: row.get(2)?,
                message_type: row.get(3)?,
                serialization: (row.get_ref(4)? == ValueRef::Text(b"cdr"))
                    .then_some(Serialization::Cdr),
                is_latched: false,
            };
            index.connect(row.get::<_, i64>(1)?.cast_unsigned(), connection);
            if index.topics.len() > MOST_TOPICS {
                return Ok(Err(format!("has more than {MOST_TOPICS} topics")));
            }
        }
        let messages = "SELECT rowid, topic_id, timestamp FROM messages NOT INDEXED";
        let mut messages = self.connection.prepare(messages)?;
        let mut rows = messages.query([])?;
        let mut last = None;
        while let Some(row) = rows.next()? {
            self.counts.store(0, Ordering::Relaxed);
            let place: i64 = row.get(0)?;
            if !ascends(&mut last, place) {
                return Ok(Err(descending()));
            }
            let topic = row.get::<_, i64>(1)?.cast_unsigned();
            let time_ns = row.get::<_, i64>(2)?.try_into().unwrap_or(0);
            if let Err(problem) = index.add(topic, time_ns, Place::Record(place.cast_unsigned())) {
                return Ok(Err(problem));
            }
        }
        Ok(Ok(index))
    }

    /// Reads a message.
    pub fn message(&self, row: i64) -> Result<Vec<u8>, String> {
        self.counts.store(0, Ordering::Relaxed);
        let data = (self.connection).blob_open("main", "messages", "data", row, true);
        let mut data = data.map_err(damaged)?;
        let length = data.len() as u64;
        read_bytes(&mut data, length)
    }
}

/// Whether a row has a larger number than the last: those of a page that is linked twice, maybe to itself, do not.
fn ascends(last: &mut Option<i64>, row: i64) -> bool {
    last.replace(row).is_none_or(|last| last < row)
}

fn descending() -> String {
    "is damaged: the rows of a table do not ascend; copy it again".to_owned()
}

fn damaged(error: Error) -> String {
    format!("is not a readable bag of SQLite: {error}; `sqlite3 FILE .recover` may repair it")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_query_without_end_is_interrupted_and_a_long_text_is_not_read() {
        let database = Database::limited(rusqlite::Connection::open_in_memory()).unwrap();
        let read = |sql: &str| {
            database.counts.store(0, Ordering::Relaxed);
            (database.connection).query_row(sql, [], |row| row.get::<_, i64>(0))
        };
        let endless = "WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n) \
             SELECT count(*) FROM n";
        let error = read(endless).unwrap_err().to_string();
        assert!(error.contains("interrupted"), "{error}");
        let error = read("SELECT length(hex(zeroblob(1000000)))").unwrap_err();
        assert!(error.to_string().contains("too big"), "{error}");
        assert_eq!(read("SELECT length(hex(zeroblob(1000)))").unwrap(), 2000);
    }
}
