"""The team on a screen: a web page for browsers and phones, and a page of text for terminals.

``web.WebView`` is the session's side: a sink that starts a server process and feeds it over a
socket, so that no browser slows the session down. ``server`` is that process, a Starlette
application that serves ``static/`` and passes requests of phones to the session. ``access`` holds
the address, token and certificate of a session's pages. ``terminal.TerminalView`` draws the page of
``text_page`` in a terminal and reads keys. Begin with ``web`` for the page, with ``text_page`` for
the terminal, with ``static/js/team_page.js`` for the code in the browser.
"""
