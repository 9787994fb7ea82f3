"""What does the browser run to show a panel?

- ``main.js``: what the view consists of, and who gets which message
- ``screen.js``, ``protocol.js``, ``outbox.js``, ``blobs.js``: how frames arrive and values leave
- ``stage.js``, ``geometry.js``, ``compare.js``, ``overlay.js``, ``probe.js``, ``roi.js``: the big picture
- ``bar.js``, ``chips.js``, ``header.js``, ``histogram.js``, ``strips.js``, ``foot.js``: what is around it
- ``rows.js``, ``boxes.js``, ``numbers.js``: what is added to the controls of the kernel's side
- ``script``: all of it as one ES module
"""
