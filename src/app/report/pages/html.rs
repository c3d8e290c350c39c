//! Tables in HTML, which a click on a column title sorts, with the definitions below.

use maud::{Markup, html};

use super::format::value_and_uncertainty;
use super::{Cell, Table};

/// Renders the table, its note and its definitions.
pub fn table(table: &Table) -> Markup {
    html! {
        div.wide {
            table id=(table.name) {
                thead {
                    tr {
                        @for (index, column) in table.columns.iter().enumerate() {
                            th scope="col" class=[table.is_numeric(index).then_some("number")] title=(column.definition) {
                                button type="button" { (column.title()) }
                            }
                        }
                    }
                }
                tbody {
                    @for row in &table.rows {
                        tr {
                            @for cell in row { (td(cell)) }
                        }
                    }
                }
            }
        }
        @if !table.note.is_empty() { p.note { (table.note) } }
        @if table.defined_columns().next().is_some() {
            details {
                summary { "Definitions" }
                dl {
                    @for column in table.defined_columns() {
                        dt { (column.title()) }
                        dd { (column.definition) }
                    }
                }
            }
        }
    }
}

fn td(cell: &Cell) -> Markup {
    let (value, uncertainty) = value_and_uncertainty(cell);
    html! {
        @if let Some(number) = cell.number() {
            td.number data-value=(number) {
                (value)
                @if !uncertainty.is_empty() { small { (uncertainty) } }
            }
        } @else if let Cell::Link { text, to } = cell {
            td { a href=(to) { (text) } }
        } @else {
            td { (value) }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::tests::example;

    #[test]
    fn a_table_has_its_numbers_to_sort_by_and_none_of_its_text_is_markup() {
        let html = super::table(&example()).into_string();
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
}
