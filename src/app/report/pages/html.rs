//! Tables in HTML, which a click on a column title sorts, with the definitions below.

use maud::{Markup, html};

use super::{Cell, Table};

/// Renders the table, its note and its definitions.
pub fn table(table: &Table) -> Markup {
    let is_numeric = |column: usize| table.rows.iter().any(|row| row[column].number.is_some());
    let defined = || table.columns.iter().filter(|it| !it.definition.is_empty());
    html! {
        div.wide {
            table id=(table.name) {
                thead {
                    tr {
                        @for (index, column) in table.columns.iter().enumerate() {
                            th scope="col" class=[is_numeric(index).then_some("number")] title=(column.definition) {
                                button type="button" { (column.title) }
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
        @if defined().next().is_some() {
            details {
                summary { "Definitions" }
                dl {
                    @for column in defined() {
                        dt { (column.title) }
                        dd { (column.definition) }
                    }
                }
            }
        }
    }
}

fn td(cell: &Cell) -> Markup {
    html! {
        @if let Some(number) = cell.number {
            td.number data-value=(number) {
                (cell.text)
                @if !cell.uncertainty.is_empty() { small { (cell.uncertainty) } }
            }
        } @else if let Some(link) = &cell.link {
            td { a href=(link) { (cell.text) } }
        } @else {
            td { (cell.text) }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::page::tests::example;

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
