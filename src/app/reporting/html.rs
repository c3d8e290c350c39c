//! Pieces of HTML: text made safe, tables that sort, pictures inside the page.

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;

use super::words::parts;
use crate::app::comparison::{Cell, Table};

/// Text that is nothing but text.
pub fn escaped(text: &str) -> String {
    text.replace('&', "&amp;")
        .replace('<', "&lt;")
        .replace('>', "&gt;")
        .replace('"', "&quot;")
}

/// A table whose heads sort it, with its definitions below.
pub fn table(table: &Table) -> String {
    let head: String = table
        .columns
        .iter()
        .enumerate()
        .map(|(index, column)| {
            let has_numbers = table.rows.iter().any(|row| row[index].number().is_some());
            let class = if has_numbers { " class=\"number\"" } else { "" };
            format!(
                "<th scope=\"col\"{class} title=\"{}\"><button type=\"button\">{}</button></th>",
                escaped(&column.definition),
                escaped(&column.head())
            )
        })
        .collect();
    let row = |row: &Vec<Cell>| -> String {
        let cells: String = row.iter().map(cell).collect();
        format!("<tr>{cells}</tr>\n")
    };
    let rows: String = table.rows.iter().map(row).collect();
    let note = if table.note.is_empty() {
        String::new()
    } else {
        format!("<p class=\"note\">{}</p>\n", escaped(&table.note))
    };
    format!(
        "<div class=\"wide\"><table id=\"{}\">\n<thead><tr>{head}</tr></thead>\n<tbody>\n{rows}</tbody></table></div>\n{note}{}",
        escaped(&table.name),
        definitions(table)
    )
}

fn cell(cell: &Cell) -> String {
    let (first, second) = parts(cell);
    let first = match cell {
        Cell::Link { text, to } => {
            format!("<a href=\"{}\">{}</a>", escaped(to), escaped(text))
        }
        _ => escaped(&first),
    };
    let Some(number) = cell.number() else {
        return format!("<td>{first}</td>");
    };
    let second = if second.is_empty() {
        second
    } else {
        format!("<small>{}</small>", escaped(&second))
    };
    format!("<td class=\"number\" data-value=\"{number}\">{first}{second}</td>")
}

fn definitions(table: &Table) -> String {
    let defined = table.columns.iter().filter(|c| !c.definition.is_empty());
    let items: String = defined
        .map(|column| {
            format!(
                "<dt>{}</dt><dd>{}</dd>\n",
                escaped(&column.head()),
                escaped(&column.definition)
            )
        })
        .collect();
    if items.is_empty() {
        return items;
    }
    format!("<details><summary>Definitions</summary><dl>\n{items}</dl></details>\n")
}

/// A picture whose bytes are in the page.
pub fn picture(png: &[u8], caption: &str) -> String {
    let caption = escaped(caption);
    format!(
        "<figure><img alt=\"{caption}\" src=\"data:image/png;base64,{}\"><figcaption>{caption}</figcaption></figure>\n",
        STANDARD.encode(png)
    )
}

#[cfg(test)]
mod tests {
    use super::super::markdown::tests::example;
    use super::*;

    #[test]
    fn a_table_has_its_numbers_to_sort_by_and_nothing_of_it_is_markup() {
        let html = table(&example());
        assert!(
            html.contains("data-value=\"0.023\">0.0230<small>±0.0020</small>"),
            "{html}"
        );
        assert!(html.contains("<a href=\"runs/b.html\">B|C</a>"), "{html}");
        assert!(
            html.contains("a | b &lt;c&gt;") && !html.contains("<c>"),
            "{html}"
        );
        assert_eq!(html.matches("<tr>").count(), 3);
        assert_eq!(html.matches("<th ").count(), 3);
    }

    #[test]
    fn the_bytes_of_a_picture_come_back_from_the_page() {
        let bytes: Vec<u8> = (0..=255).collect();
        let html = picture(&bytes, "\"<path>\"");
        let (_, rest) = html.split_once("base64,").unwrap();
        let (encoded, _) = rest.split_once('"').unwrap();
        assert_eq!(STANDARD.decode(encoded).unwrap(), bytes);
        assert!(!html.contains("<path>"));
    }
}
