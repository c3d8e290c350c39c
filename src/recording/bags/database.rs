//! `.db3` of rosbag2: a database of SQLite with the tables `topics` and `messages`.

use std::path::Path;

use rusqlite::types::ValueRef;
use rusqlite::{Connection as Database, Error, OpenFlags};

use super::index::{Connection, Index, Place, Serialization};

/// Opens a database without writing next to it.
pub fn open(path: &Path) -> Result<Database, String> {
    let mut log = path.as_os_str().to_owned();
    log.push("-wal");
    // A database whose recorder was interrupted has messages in its log, which needs a lock.
    let is_immutable = u8::from(!Path::new(&log).exists());
    let absolute = std::path::absolute(path).map_err(|error| error.to_string())?;
    let escaped = absolute.to_string_lossy().replace('%', "%25");
    let escaped = escaped.replace('?', "%3f").replace('#', "%23");
    let name = format!("file:{escaped}?immutable={is_immutable}");
    let flags = OpenFlags::SQLITE_OPEN_READ_ONLY
        | OpenFlags::SQLITE_OPEN_URI
        | OpenFlags::SQLITE_OPEN_NO_MUTEX;
    Database::open_with_flags(name, flags).map_err(damaged)
}

fn damaged(error: Error) -> String {
    format!("is not a readable bag of SQLite: {error}; `sqlite3 FILE .recover` may repair it")
}

/// Reads the index of a file.
pub fn index(database: &Database, number: usize) -> Result<Index, String> {
    read_index(database, number).map_err(damaged)?
}

fn read_index(database: &Database, number: usize) -> Result<Result<Index, String>, Error> {
    let mut index = Index::of_file(number);
    let mut topics = database.prepare("SELECT id, name, type, serialization_format FROM topics")?;
    let mut rows = topics.query([])?;
    while let Some(row) = rows.next()? {
        let connection = Connection {
            topic: row.get(1)?,
            message_type: row.get(2)?,
            serialization: (row.get_ref(3)? == ValueRef::Text(b"cdr"))
                .then_some(Serialization::Cdr),
            is_latched: false,
        };
        index.connect(row.get::<_, i64>(0)?.cast_unsigned(), connection);
    }
    let mut messages = database.prepare("SELECT topic_id, timestamp, id FROM messages")?;
    let mut rows = messages.query([])?;
    while let Some(row) = rows.next()? {
        let topic = row.get::<_, i64>(0)?.cast_unsigned();
        let time_ns = row.get::<_, i64>(1)?.try_into().unwrap_or(0);
        if let Err(problem) = index.add(topic, time_ns, Place::Row(row.get(2)?)) {
            return Ok(Err(problem));
        }
    }
    Ok(Ok(index))
}

/// Reads a message.
pub fn message(database: &Database, row: i64) -> Result<Vec<u8>, String> {
    let read = || {
        let mut statement = database.prepare("SELECT data FROM messages WHERE id = ?1")?;
        statement.query_row([row], |row| Ok(row.get_ref(0)?.as_bytes()?.to_vec()))
    };
    read().map_err(damaged)
}
