// A button at every block of commands that copies it; without one the text can still be marked by hand.
for (const text of document.querySelectorAll(".commands pre")) {
  const button = document.createElement("button");
  Object.assign(button, { type: "button", textContent: "Copy" });
  button.onclick = async () => {
    try {
      await navigator.clipboard.writeText(text.textContent);
    } catch {
      getSelection().selectAllChildren(text); // where the browser gives pages no clipboard
      document.execCommand("copy");
    }
    button.textContent = "Copied";
    setTimeout(() => { button.textContent = "Copy"; }, 1500);
  };
  text.before(button);
}
