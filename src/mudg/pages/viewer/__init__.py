"""The viewer page: a fitted scene packed for a browser, and the HTML around it. The browser's side is in ``assets/viewer``."""
