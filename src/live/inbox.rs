//! Scans between the thread that receives them and the one that computes.

use std::collections::VecDeque;
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

/// A scan that waits, and when it arrived.
#[derive(Clone, Debug, PartialEq)]
pub struct Arrival<T> {
    /// The scan.
    pub scan: T,
    /// When it arrived.
    pub arrived: Instant,
}

/// What an inbox has for the thread that computes.
#[derive(Clone, Debug, PartialEq)]
pub enum Received<T> {
    /// The oldest waiting scan.
    Scan(Arrival<T>),
    /// None arrived in time.
    Nothing,
    /// None will arrive.
    End,
}

/// Scans that wait, at most as many as the capacity: when one more arrives, the oldest is dropped. Whoever sends is never
/// slowed by whoever receives.
#[derive(Debug)]
pub struct Inbox<T> {
    capacity: usize,
    content: Mutex<Content<T>>,
    changed: Condvar,
}

#[derive(Debug)]
struct Content<T> {
    waiting: VecDeque<Arrival<T>>,
    received: u64,
    dropped: u64,
    is_closed: bool,
}

impl<T> Inbox<T> {
    /// An empty inbox, for at least one scan.
    pub fn new(capacity: usize) -> Self {
        Self {
            capacity: capacity.max(1),
            content: Mutex::new(Content {
                waiting: VecDeque::new(),
                received: 0,
                dropped: 0,
                is_closed: false,
            }),
            changed: Condvar::new(),
        }
    }

    /// Adds a scan that arrives now.
    pub fn push(&self, scan: T) {
        self.push_arrived(scan, Instant::now());
    }

    /// Adds a scan that arrived before, and was decoded since then.
    pub fn push_arrived(&self, scan: T, arrived: Instant) {
        let mut content = self.content();
        content.received += 1;
        content.waiting.push_back(Arrival { scan, arrived });
        if content.waiting.len() > self.capacity {
            content.waiting.pop_front();
            content.dropped += 1;
        }
        drop(content);
        self.changed.notify_all();
    }

    /// Waits for a scan, at most for a time.
    pub fn take(&self, timeout: Duration) -> Received<T> {
        let is_waiting =
            |content: &mut Content<T>| content.waiting.is_empty() && !content.is_closed;
        let waited = (self.changed).wait_timeout_while(self.content(), timeout, is_waiting);
        let (mut content, _) = waited.unwrap_or_else(PoisonError::into_inner);
        match content.waiting.pop_front() {
            Some(arrival) => Received::Scan(arrival),
            None if content.is_closed => Received::End,
            None => Received::Nothing,
        }
    }

    /// Returns a scan that was taken, as the oldest one; it is dropped where newer ones have taken its place.
    pub fn put_back(&self, arrival: Arrival<T>) {
        let mut content = self.content();
        if content.waiting.len() < self.capacity {
            content.waiting.push_front(arrival);
        } else {
            content.dropped += 1;
        }
    }

    /// Whether no scan waits.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Number of scans that wait.
    pub fn len(&self) -> usize {
        self.content().waiting.len()
    }

    /// Whether the reception has ended.
    pub fn is_closed(&self) -> bool {
        self.content().is_closed
    }

    /// Ends the reception, by either side: what waits can still be taken.
    pub fn close(&self) {
        self.content().is_closed = true;
        self.changed.notify_all();
    }

    /// Number of all scans that arrived.
    pub fn received(&self) -> u64 {
        self.content().received
    }

    /// Number of those that were dropped.
    pub fn dropped(&self) -> u64 {
        self.content().dropped
    }

    fn content(&self) -> MutexGuard<'_, Content<T>> {
        self.content.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn taken(inbox: &Inbox<u32>) -> Vec<u32> {
        let next = || match inbox.take(Duration::ZERO) {
            Received::Scan(arrival) => Some(arrival.scan),
            Received::Nothing | Received::End => None,
        };
        std::iter::from_fn(next).collect()
    }

    #[test]
    fn the_oldest_waiting_scans_are_dropped_and_every_scan_is_taken_or_dropped() {
        for capacity in 1..4 {
            let inbox = Inbox::new(capacity);
            (0..10).for_each(|scan| inbox.push(scan));
            assert_eq!((inbox.len(), inbox.is_empty()), (capacity, false));
            let newest: Vec<u32> = (10 - capacity as u32..10).collect();
            assert_eq!(taken(&inbox), newest);
            assert_eq!(
                (inbox.received(), inbox.dropped()),
                (10, 10 - capacity as u64)
            );
        }
    }

    #[test]
    fn a_scan_that_is_put_back_is_the_next_one_unless_newer_ones_fill_the_inbox() {
        let inbox = Inbox::new(2);
        inbox.push(1);
        inbox.push(2);
        let Received::Scan(first) = inbox.take(Duration::ZERO) else {
            panic!("a scan waits");
        };
        inbox.put_back(first.clone());
        assert_eq!(inbox.take(Duration::ZERO), Received::Scan(first.clone()));
        inbox.push(3);
        inbox.put_back(first);
        assert_eq!((taken(&inbox), inbox.dropped()), (vec![2, 3], 1));
    }

    #[test]
    fn the_arrival_is_that_of_the_message_and_not_that_of_the_decoded_scan() {
        let inbox = Inbox::new(1);
        let arrived = Instant::now();
        inbox.push_arrived(5, arrived);
        let expected = Received::Scan(Arrival { scan: 5, arrived });
        assert_eq!(inbox.take(Duration::ZERO), expected);
    }

    #[test]
    fn what_waits_is_taken_before_the_end() {
        let inbox = Inbox::new(2);
        assert_eq!(inbox.take(Duration::ZERO), Received::Nothing);
        inbox.push(1);
        inbox.close();
        assert_eq!(taken(&inbox), [1]);
        assert_eq!(inbox.take(Duration::MAX), Received::End);
    }

    #[test]
    fn a_thread_that_waits_is_woken_by_a_scan_of_another() {
        let inbox = Inbox::new(1);
        std::thread::scope(|scope| {
            let waiting = scope.spawn(|| inbox.take(Duration::from_secs(600)));
            inbox.push(7);
            assert!(matches!(waiting.join(), Ok(Received::Scan(it)) if it.scan == 7));
        });
    }
}
